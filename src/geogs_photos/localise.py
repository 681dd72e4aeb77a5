"""Pose of a frame from the points of a reconstruction of other frames."""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from geogs.application.structure_from_motion.photos import PlacedVideo
from geogs.geometry.camera import Camera
from geogs.types import Frame
from geogs_photos.photo_features import find_features, squared_distances
from geogs_photos.pycolmap_library import load_colmap
from geogs_photos.verified_matches import MAX_ERROR

NEIGHBOURS = 2
"""Number of frames with a pose, before and after a frame, whose points it is matched with."""
LEAST_INLIERS = 20
"""Fewest inliers of an accepted pose."""
_RATIO = 0.8


class Localiser:
    """Estimates poses from the points that frames with a pose see, with their descriptors."""

    def __init__(self, video: PlacedVideo, camera: Camera, seed: int) -> None:
        """``camera`` is that of the frames to localise."""
        self._positions = video.positions
        self._descriptors = video.descriptors
        self._places = np.array(video.numbers)
        colmap = load_colmap()
        self._camera: Any = colmap.Camera(
            model=colmap.CameraModelId.PINHOLE,
            width=camera.width,
            height=camera.height,
            params=[camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5],
        )
        self._options = colmap.AbsolutePoseEstimationOptions()
        self._options.ransac.max_error = MAX_ERROR
        self._options.ransac.random_seed = seed

    def place(self, frame: Frame) -> Float64[np.ndarray, "4 4"] | None:
        """World to camera of a frame of the video; none if there are too few inliers."""
        near = self._near(frame.index)
        positions = np.concatenate([self._positions[k] for k in near])
        descriptors = np.concatenate([self._descriptors[k] for k in near])
        features = find_features(frame.image, frame.mask)
        if len(features) < LEAST_INLIERS or len(positions) < LEAST_INLIERS:
            return None
        own, known = matches_to_points(features.descriptors, descriptors, positions)
        if len(own) < LEAST_INLIERS:
            return None
        pixels = features.keypoints[own, :2].astype(np.float64) + 0.5
        found = load_colmap().estimate_and_refine_absolute_pose(
            pixels, positions[known], self._camera, self._options
        )
        if found is None or found["num_inliers"] < LEAST_INLIERS:
            return None
        T_cw = np.eye(4)
        T_cw[:3] = found["cam_from_world"].matrix()
        return T_cw

    def _near(self, number: int) -> list[int]:
        at = int(np.searchsorted(self._places, number))
        return list(range(max(0, at - NEIGHBOURS), min(len(self._places), at + NEIGHBOURS)))


def matches_to_points(
    own: UInt8[np.ndarray, "n 128"],
    descriptors: UInt8[np.ndarray, "m 128"],
    positions: Float64[np.ndarray, "m 3"],
) -> tuple[Int64[np.ndarray, "k"], Int64[np.ndarray, "k"]]:
    """Features and points that are each other's nearest by their descriptors.

    The second nearest has to be clearly farther, unless it is the same point in another frame.
    """
    distance = squared_distances(own.astype(np.float32), descriptors.astype(np.float32)).clip(0)
    rows = np.arange(len(own))
    nearest = distance.argmin(1)
    best = distance[rows, nearest].copy()
    is_mutual = distance.argmin(0)[nearest] == rows
    other = np.abs(positions[None, :, :] - positions[nearest][:, None, :]).max(-1) > 1e-9
    second = np.where(other, distance, np.inf).min(1)
    kept = np.flatnonzero(is_mutual & (best < _RATIO**2 * second))
    return kept, nearest[kept]
