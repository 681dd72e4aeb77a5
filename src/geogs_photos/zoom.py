"""Test for a zoom in a video that structure from motion assumes to be of one lens.

A motion along the view and points at wrong distances explain a zoom nearly as well: the
reprojection error is two thirds of a pixel instead of a half, without a visible reason.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs_photos.incremental_mapping import adjust_free
from geogs_photos.pycolmap_library import load_colmap

PARTS = 6
"""Number of parts of a video, each with its own lens."""
MAX_ERROR_RATIO, LEAST_CHANGE = 0.93, 0.03
"""Largest ratio of the reprojection error with these to that with one lens, and the least relative
difference of their focal lengths: 0.78 and 7 % for a zoom by four fifths, 0.90 and 14 % for one by
a half in five images, 0.97 and more without a zoom (docs/notebook/uncertainty.md has the
limits)."""


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
    errors = []
    for adjusts in (False, True):
        if adjusts:
            adjust_free(parted, ())
        parted.update_point_3d_errors()
        errors.append(parted.compute_mean_reprojection_error())
    focal = [parted.cameras[number].mean_focal_length() for number in range(1, PARTS + 1)]
    return np.array(focal) / camera.mean_focal_length(), errors[1] / errors[0]


def _parted(model: Any, images: Sequence[Any], camera: Any) -> Any:
    """Copy the reconstruction with one camera for each part."""
    colmap = load_colmap()
    parted = colmap.Reconstruction()
    for number in range(1, PARTS + 1):
        own = colmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params,
            camera_id=number,
        )  # fmt: skip
        parted.add_camera_with_trivial_rig(own)
    for place, image in enumerate(images):
        seen = np.array([point.xy for point in image.points2D])
        copied = colmap.Image(
            name=image.name, keypoints=seen, camera_id=1 + place * PARTS // len(images),
            image_id=image.image_id,
        )  # fmt: skip
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
