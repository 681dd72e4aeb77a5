"""Structure from motion of chosen frames of a video, with tests of what it assumes.

It assumes one lens: a motion along the view and points at wrong distances explain a zoom nearly as
well; the reprojection error is two thirds of a pixel instead of a half, without a visible reason.

Frames far apart have too little in common to track rows of a rolling shutter between them, but
points that many of them see still determine the readout. Rows are moved to where a global shutter
would see them, by the motion of the camera from the previous to the next frame, and poses and
points are adjusted again.
"""

import math
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.linalg import logm

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.application.structure_from_motion.photos import PlacedVideo
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import calibration_from_colmap
from geogs.stopwatch import StageProgress
from geogs_photos.contradictions import only_rotates
from geogs_photos.database import Entry, SharedCamera
from geogs_photos.deviations import pose_deviations
from geogs_photos.fragments import rejoined
from geogs_photos.incremental_mapping import (
    LEAST_IMAGES,
    adjust,
    placed_images,
    refine,
    shifts,
    world_to_camera,
)
from geogs_photos.photo_features import frame_features
from geogs_photos.photo_pairs import frame_pairs
from geogs_photos.poses import structure_of
from geogs_photos.pycolmap_library import load_colmap
from geogs_photos.upright import make_upright
from geogs_photos.verified_matches import MAX_ERROR

MOST_CHANGE = 0.1
"""Largest relative change of a focal length that the video determined before. With a larger one,
one of both is wrong, and shape and path bend: for a rotating camera, points at wrong distances
explain any focal length."""
PARTS = 6
"""Number of parts of a video with their own lenses in the test for a zoom."""
MAX_ERROR_RATIO = 0.93
"""Largest ratio of the reprojection error with these to that with one lens, if there is a zoom:
0.78 for one by four fifths, 0.90 for one by a half in five images, 0.97 and more without a zoom
(docs/notebook/uncertainty.md has the limits)."""
LEAST_CHANGE = 0.03
"""Least relative difference of the focal lengths then: 7 % and 14 % for these zooms."""
TRIAL_READOUT = 0.1
"""Trial readout, as a fraction of the time between frames: 20 ms at five a second."""
MAX_READOUT = 2.0
"""Largest readout, as a multiple of the trial readout."""
UNSURE_FRACTION = 0.33
"""Standard deviation of a shift by the readout, as a fraction of it, as the motion between frames
is only roughly known. Measured on videos with a truth (docs/notebook/photographs.md)."""
_MAX_GAP = 2.5
"""Largest time between frames with known motion, as a multiple of the median."""


def place_frames(
    chosen: ChosenFrames,
    camera: Camera,
    is_known: bool,
    is_found: bool,
    is_rolling: bool,
    seed: int,
    progress: StageProgress,
) -> PlacedVideo:
    """Implements ``geogs.application.structure_from_motion.photos.place_frames``."""
    load_colmap()  # fails at once if it is missing
    # A camera to be estimated has one focal length: pixels become square.
    squeeze = 1.0 if is_known else camera.fy / camera.fx
    square = camera.resized(round(squeeze * camera.width), camera.height)
    begin = Calibration(
        square.fx,
        square.fy,
        square.cx,
        square.cy,
        width=square.width,
        height=square.height,
        is_guess=not (is_known or is_found),
    )
    features = frame_features(chosen.frames, progress)
    features = [some.stretched(square.width / camera.width) for some in features]
    pairs = frame_pairs(features, seed, progress)
    count = len(chosen.frames)
    entries = [Entry(f"{k:06d}", 0, some) for k, some in enumerate(features)]
    shared = [SharedCamera(begin, is_known)]
    with tempfile.TemporaryDirectory(prefix="geogs-video-") as work:
        database = Path(work) / "database.db"
        parts, _ = structure_of(database, shared, entries, pairs, seed, progress)
        parts = rejoined(parts, database, count, shared, seed, progress)
        if parts and only_rotates(parts[0], database):
            raise InputError(
                "The camera only turns: a turn alone explains what nearly all pairs of frames "
                "show; move it sideways, too."
            )
    best = refine(parts[0], shared) if parts else None
    images = [] if best is None else placed_images(best)
    if best is None or len(images) < LEAST_IMAGES:
        raise InputError(
            f"Of {count} sharp frames no three tell where they were taken; the camera has to move, "
            "and the scene to show texture."
        )
    make_upright(best, images, [0] * len(images))
    # Before the readout is estimated, which would explain much of a zoom.
    has_zoomed = zooms(best, images)
    unsure = np.zeros(len(images))
    if is_rolling:
        progress("finding the readout", 0.0)
        times = np.array([frame.timestamp for frame in chosen.frames])
        known = set(best.cameras) if is_known else set[int]()
        best, unsure = with_rows_at_once(best, times, known)
        progress("finding the readout", 1.0)
    placed = _placed(best, chosen, entries, is_known)
    placed = replace(placed, calibration=_of_frames(placed.calibration, camera))
    placed = replace(placed, deviation=np.hypot(placed.deviation, unsure))
    is_other = is_found and abs(math.log(placed.calibration.fx / camera.fx)) > MOST_CHANGE
    if is_other or has_zoomed:
        unknown = np.full(len(images), np.inf)
        return replace(placed, deviation=unknown, rotation=unknown, depth=unknown)
    return placed


def _of_frames(found: Calibration, frames: Camera) -> Calibration:
    """The camera of square pixels, for the pixels of the frames."""
    width, height = frames.width, frames.height
    own = found.camera().resized(width, height)
    return replace(found, fx=own.fx, fy=own.fy, cx=own.cx, cy=own.cy, width=width, height=height)


def _placed(
    model: Any, chosen: ChosenFrames, entries: Sequence[Entry], is_known: bool
) -> PlacedVideo:
    images = placed_images(model)
    T_cw = np.stack([world_to_camera(image) for image in images])
    positions = []
    descriptors = []
    for image in images:
        seen = [(k, p.point3D_id) for k, p in enumerate(image.points2D) if p.has_point3D()]
        positions.append(np.array([model.points3D[p].xyz for _, p in seen]).reshape(-1, 3))
        descriptors.append(entries[int(image.name)].features.descriptors[[k for k, _ in seen]])
    camera = next(iter(model.cameras.values()))
    calibration = calibration_from_colmap(
        camera.model.name, camera.width, camera.height, camera.params.tolist(), "the video itself"
    )
    error = float(model.compute_mean_reprojection_error())
    deviation, rotation = pose_deviations(model, images, T_cw, is_known)
    depth = np.array([_depth_deviation(model, image, error) for image in images])
    numbers = tuple(chosen.frames[int(image.name)].index for image in images)
    return PlacedVideo(
        chosen.timestamps,
        len(chosen.frames),
        numbers,
        T_cw,
        deviation,
        rotation,
        depth,
        tuple(positions),
        tuple(descriptors),
        calibration,
        error,
    )


def _depth_deviation(model: Any, image: Any, error: float) -> float:
    """Median relative standard deviation of the depths of an image's points, by their parallax.

    The relative standard deviation for rays that meet at an angle a is error / (f a).
    """
    focal = float(model.cameras[image.camera_id].mean_focal_length())
    centre = image.projection_center()
    found = []
    for number in {p.point3D_id for p in image.points2D if p.has_point3D()}:
        point = model.points3D[number]
        others = [model.images[e.image_id] for e in point.track.elements]
        rays = np.stack([point.xyz - other.projection_center() for other in others])
        ray = point.xyz - centre
        cosine = rays @ ray / (np.linalg.norm(rays, axis=1) * np.linalg.norm(ray)).clip(1e-12)
        angle = float(np.arccos(cosine.clip(-1, 1)).max())
        found.append(error / (focal * max(angle, 1e-6)))
    return float(np.median(found)) if found else float("inf")


def zooms(model: Any, images: Sequence[Any]) -> bool:
    """Whether separate focal lengths for the parts of a video explain it far better.

    Args:
        model: an adjusted reconstruction by one camera; it is not changed.
        images: its pictures, in the order of time.
    """
    if len(images) < 2 * PARTS:
        return False
    focal, left = with_own_lenses(model, images)
    return left < MAX_ERROR_RATIO and float(np.ptp(np.log(focal))) > LEAST_CHANGE


def with_own_lenses(model: Any, images: Sequence[Any]) -> tuple[Float64[np.ndarray, "p"], float]:
    """Adjust everything with separate focal lengths for the parts of a video; return their ratios
    to the common one, and that of the mean reprojection errors."""
    camera = next(iter(model.cameras.values()))
    parted = _parted(model, images, camera)
    parted.update_point_3d_errors()
    error = parted.compute_mean_reprojection_error()
    adjust(parted, ())
    parted.update_point_3d_errors()
    focal = [parted.cameras[number].mean_focal_length() for number in range(1, PARTS + 1)]
    ratio = parted.compute_mean_reprojection_error() / error
    return np.array(focal) / camera.mean_focal_length(), ratio


def _parted(model: Any, images: Sequence[Any], camera: Any) -> Any:
    """Copy the reconstruction with one camera for each part."""
    colmap = load_colmap()
    parted = colmap.Reconstruction()
    for number in range(1, PARTS + 1):
        own = colmap.Camera(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            params=camera.params,
            camera_id=number,
        )
        parted.add_camera_with_trivial_rig(own)
    for place, image in enumerate(images):
        seen = np.array([point.xy for point in image.points2D])
        copied = colmap.Image(
            name=image.name,
            keypoints=seen,
            camera_id=1 + place * PARTS // len(images),
            image_id=image.image_id,
        )
        parted.add_image_with_trivial_frame(copied, image.cam_from_world())
    kept = {image.image_id for image in images}
    for point in model.points3D.values():
        seen_in = [e for e in point.track.elements if e.image_id in kept]
        if len(seen_in) >= 2:
            track = colmap.Track()
            for element in seen_in:
                track.add_element(element.image_id, element.point2D_idx)
            parted.add_point3D(point.xyz, track, point.color)
    return parted


def with_rows_at_once(
    model: Any, times: Float64[np.ndarray, "n"], known: Collection[int]
) -> tuple[Any, Float64[np.ndarray, "m"]]:
    """Estimate the readout; return the corrected reconstruction and its added uncertainty.

    Args:
        model: its images are named by their index in ``times``.
        times: of the frames, seconds.
        known: numbers of the cameras that are fixed.

    Returns:
        The reconstruction, and the standard deviation (world units) to be added to that of the
        centre of each image of ``placed_images``.
    """
    model.update_point_3d_errors()  # its stored errors are older than its poses
    step = TRIAL_READOUT * float(np.median(np.diff(times)))
    trials = [_adjusted(model, times, readout, known) for readout in (-step, step)]
    squares = [_square(m) for m in (trials[0], model, trials[1])]
    bend = squares[0] + squares[2] - 2 * squares[1]
    best = 0.5 * (squares[0] - squares[2]) / bend if bend > 0 else 0.0
    found = _adjusted(model, times, float(np.clip(best, -MAX_READOUT, MAX_READOUT)) * step, known)
    for number in [n for n, point in found.points3D.items() if not point.error <= MAX_ERROR]:
        found.delete_point3D(number)
    numbers = [image.image_id for image in placed_images(found)]
    return found, UNSURE_FRACTION * shifts(model, found, numbers)


def _square(model: Any) -> float:
    """Mean squared reprojection error of the points, each at most ``MAX_ERROR`` squared."""
    error = np.nan_to_num([point.error for point in model.points3D.values()], nan=MAX_ERROR)
    return float(np.square(error.clip(max=MAX_ERROR)).mean())


def _adjusted(
    model: Any, times: Float64[np.ndarray, "n"], readout: float, known: Collection[int]
) -> Any:
    """Copy a reconstruction with rows moved to a global shutter by this readout, and adjust it."""
    copy = load_colmap().Reconstruction(model)
    images = placed_images(model)
    places = [int(image.name) for image in images]
    T_cw = [world_to_camera(image) for image in images]
    step = _MAX_GAP * np.median(np.diff(times))
    for k, image in enumerate(images):
        around = range(max(0, k - 1), min(len(images), k + 2))
        near = [j for j in around if abs(times[places[j]] - times[places[k]]) <= step]
        a = near[0]
        b = near[-1]
        if a == b:
            continue
        seconds = times[places[b]] - times[places[a]]
        velocity = np.real(logm(T_cw[b] @ np.linalg.inv(T_cw[a]))) / seconds
        _shift(model, image, copy.images[image.image_id], T_cw[k], readout * velocity)
    adjust(copy, known)
    copy.update_point_3d_errors()
    return copy


def _shift(
    model: Any,
    image: Any,
    copy: Any,
    T: Float64[np.ndarray, "4 4"],
    motion: Float64[np.ndarray, "4 4"],
) -> None:
    """Move the pixels of an image's points by the camera's motion up to the time of their rows."""
    camera = model.cameras[image.camera_id]
    seen = [k for k, p in enumerate(image.points2D) if p.has_point3D()]
    points = np.array([model.points3D[image.points2D[k].point3D_id].xyz for k in seen])
    pixels = np.array([image.points2D[k].xy for k in seen])
    still = points @ T[:3, :3].T + T[:3, 3]
    late = pixels[:, 1] / camera.height - 0.5
    moved = still + late[:, None] * (still @ motion[:3, :3].T + motion[:3, 3])
    pixels -= np.asarray(camera.img_from_cam(moved)) - np.asarray(camera.img_from_cam(still))
    for k, pixel in zip(seen, pixels, strict=True):
        copy.points2D[k].xy = pixel
