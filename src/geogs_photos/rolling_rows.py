"""Readout of an unknown rolling shutter, estimated from residuals of structure from motion.

Frames far apart have too little in common to track rows between them, but points that many of them
see still determine the readout. Rows are moved to where a global shutter would see them, by the
motion of the camera from the previous to the next frame, and poses and points are adjusted again.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.linalg import logm

from geogs_photos.incremental_mapping import placed_images, shifts, world_to_camera
from geogs_photos.pycolmap_library import load_colmap
from geogs_photos.verified_matches import MAX_ERROR

TRIAL_READOUT = 0.1
"""Trial readout, as a fraction of the time between frames: 20 ms at five a second."""
MAX_READOUT = 2.0
"""Largest readout, as a multiple of the trial readout."""
UNSURE_FRACTION = 0.33
"""Standard deviation of a shift by the readout, as a fraction of it, as the motion between frames
is only roughly known. Measured on videos with a truth (docs/notebook/photographs.md)."""
_MAX_GAP = 2.5
"""Largest time between frames with known motion, as a multiple of the median."""


def with_rows_at_once(
    model: Any, times: Float64[np.ndarray, "n"], adjust: Callable[[Any], None]
) -> tuple[Any, Float64[np.ndarray, "m"]]:
    """Estimate the readout; return the corrected reconstruction and its added uncertainty.

    Args:
        model: its images are named by their index in ``times``.
        times: of the frames, seconds.
        adjust: adjusts a reconstruction in place.

    Returns:
        The reconstruction, and the standard deviation (world units) to be added to that of the
        centre of each image of ``placed_images``.
    """
    model.update_point_3d_errors()  # its stored errors are older than its poses
    step = TRIAL_READOUT * float(np.median(np.diff(times)))
    trials = [_adjusted(model, times, readout, adjust) for readout in (-step, step)]
    squares = [_square(m) for m in (trials[0], model, trials[1])]
    bend = squares[0] + squares[2] - 2 * squares[1]
    best = 0.5 * (squares[0] - squares[2]) / bend if bend > 0 else 0.0
    found = _adjusted(model, times, float(np.clip(best, -MAX_READOUT, MAX_READOUT)) * step, adjust)
    for number in [n for n, point in found.points3D.items() if not point.error <= MAX_ERROR]:
        found.delete_point3D(number)
    numbers = [image.image_id for image in placed_images(found)]
    return found, UNSURE_FRACTION * shifts(model, found, numbers)


def _square(model: Any) -> float:
    """Mean squared reprojection error of the points, each at most ``MAX_ERROR`` squared."""
    error = np.nan_to_num([point.error for point in model.points3D.values()], nan=MAX_ERROR)
    return float(np.square(error.clip(max=MAX_ERROR)).mean())


def _adjusted(
    model: Any, times: Float64[np.ndarray, "n"], readout: float, adjust: Callable[[Any], None]
) -> Any:
    """Copy a reconstruction with rows moved to a global shutter by this readout, and adjust it."""
    copy, images = load_colmap().Reconstruction(model), placed_images(model)
    places = [int(image.name) for image in images]
    T_cw, step = [world_to_camera(image) for image in images], _MAX_GAP * np.median(np.diff(times))
    for k, image in enumerate(images):
        around = range(max(0, k - 1), min(len(images), k + 2))
        near = [j for j in around if abs(times[places[j]] - times[places[k]]) <= step]
        a, b = near[0], near[-1]
        if a == b:
            continue
        seconds = times[places[b]] - times[places[a]]
        velocity = np.real(logm(T_cw[b] @ np.linalg.inv(T_cw[a]))) / seconds
        _shift(model, image, copy.images[image.image_id], T_cw[k], readout * velocity)
    adjust(copy)
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
