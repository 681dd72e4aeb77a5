"""Verified matches of the pictures of a reconstruction, with their poses."""

from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from geogs.geometry.epipolar import epipolar_distance, homogeneous, in_front_of_both
from geogs_photos.incremental_mapping import world_to_camera
from geogs_photos.pycolmap_library import load_colmap

MAX_ERROR = 4.0
"""Largest residual of a match that is explained, such as to its epipolar line, pixels."""


@dataclass(frozen=True, slots=True)
class PairMatches:
    """Matches of two pictures that one motion of the camera explains, found without poses."""

    one: int
    other: int
    """Numbers of both pictures."""
    T: Float64[np.ndarray, "4 4"]
    """First camera to second, by their poses."""
    rays: tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]
    """Undistorted rays, at depth 1."""
    focal: float
    """Focal length, pixels."""

    def epipolar(self) -> Float64[np.ndarray, "n"]:
        """Distances of the matches from the epipolar geometry of the poses, pixels."""
        return self.focal * epipolar_distance(self.T, np.eye(3), *self.rays)

    def in_front(self) -> Bool[np.ndarray, "n"]:
        """Mask of the matches whose point is in front of both cameras, or too far to decide."""
        return in_front_of_both(self.T, *self.rays, MAX_ERROR / self.focal)


def verified_matches(
    model: Any, database: Path, pictures: Collection[int]
) -> Iterator[PairMatches]:
    """Verified matches of all pairs of some pictures with a pose, without pixels outside the
    estimated lens."""
    colmap = load_colmap()
    with closing(colmap.Database.open(database)) as opened:
        ids, _ = opened.read_two_view_geometry_num_inliers()
        rays = {n: _rays(model, opened, n) for n in pictures}
        for one, other in (colmap.pair_id_to_image_pair(i) for i in ids):
            if one not in rays or other not in rays:
                continue
            matches = opened.read_two_view_geometry(one, other).inlier_matches
            a, b = rays[one][matches[:, 0]], rays[other][matches[:, 1]]
            is_seen = np.isfinite(a).all(1) & np.isfinite(b).all(1)
            if not is_seen.any():
                continue
            first, second = (world_to_camera(model.images[n]) for n in (one, other))
            yield PairMatches(
                one,
                other,
                second @ np.linalg.inv(first),
                (a[is_seen], b[is_seen]),
                float(model.cameras[model.images[one].camera_id].mean_focal_length()),
            )


def _rays(model: Any, opened: Any, number: int) -> Float64[np.ndarray, "n 3"]:
    """Rays of all features; not finite outside the domain of the lens's distortion."""
    camera = model.cameras[model.images[number].camera_id]
    pixels = np.asarray(opened.read_keypoints(number), np.float64)[:, :2]
    return homogeneous(np.asarray(camera.cam_from_img(pixels), np.float64)[:, :2])
