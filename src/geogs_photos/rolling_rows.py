"""A rolling shutter that a video did not tell, as the residuals of structure from motion tell it.

Frames far apart share too little for their rows to be followed; points that many of them see show
the readout all the same. Rows are put where all of them would be seen at once, by the motion of the
camera from the frame before to the frame after, and poses and points adjusted once more.
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
"""Readout that is tried, of the time from one frame to the next: 20 ms of five a second."""
MAX_READOUT = 2.0
"""Largest readout, over the one that is tried."""
UNSURE_FRACTION = 0.33
"""Part of what a readout moves that stays unsure, as motion between frames is only roughly known.
Measured on videos with a truth (docs/notebook/photographs.md)."""
_MAX_GAP = 2.5
"""Times the usual step of time from which on motion between two frames is not known."""


def with_rows_at_once(
    model: Any, times: Float64[np.ndarray, "n"], adjust: Callable[[Any], None]
) -> tuple[Any, Float64[np.ndarray, "m"]]:
    """A reconstruction with its readout found, and the deviations that this leaves (world units).

    Args:
        model: its images are called by their place in ``times``.
        times: of the frames, seconds.
        adjust: adjusts a reconstruction in place.

    Returns:
        The reconstruction, and what is to be added to the deviation of the centre of each image of
        ``placed_images``.
    """
    model.update_point_3d_errors()  # those that it comes with are older than its poses
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
    """Mean squared distance of the points from where they were seen; what is far off is far off."""
    error = np.nan_to_num([point.error for point in model.points3D.values()], nan=MAX_ERROR)
    return float(np.square(error.clip(max=MAX_ERROR)).mean())


def _adjusted(
    model: Any, times: Float64[np.ndarray, "n"], readout: float, adjust: Callable[[Any], None]
) -> Any:
    """A copy whose rows are put where all would be seen at once."""
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
    """Move the pixels of an image's points by what its camera moved until their rows were read."""
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
