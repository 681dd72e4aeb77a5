"""Whether somebody zooms in a video that structure from motion takes for that of one lens.

A zoom is explained by a motion along the view and points at wrong distances, nearly as well: points
are two thirds of a pixel from where they were seen instead of half a one, and nothing says why.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs_photos.incremental_mapping import adjust_free
from geogs_photos.pycolmap_library import load_colmap

PARTS = 6
"""Parts of a video that have lenses of their own."""
MAX_ERROR_RATIO, LEAST_CHANGE = 0.93, 0.03
"""Reprojection error with these over that with one lens, at most, and the least relative difference
of their focal lengths: 0.78 and 7 % where somebody zooms by four fifths,
0.90 and 14 % where by a half in five images, 0.97 and more where nobody does
(docs/notebook/uncertainty.md has what that leaves)."""


def zooms(model: Any, images: Sequence[Any]) -> bool:
    """Whether parts of a video with focal lengths of their own explain what it shows far better.

    Args:
        model: an adjusted reconstruction by one camera; it stays as it is.
        images: its pictures, in the order of time.
    """
    if len(images) < 2 * PARTS:
        return False
    focal, left = with_own_lenses(model, images)
    return left < MAX_ERROR_RATIO and float(np.ptp(np.log(focal))) > LEAST_CHANGE


def with_own_lenses(model: Any, images: Sequence[Any]) -> tuple[Float64[np.ndarray, "p"], float]:
    """Focal lengths of the parts of a video over the common one, when everything is adjusted with
    them, and the part that is left of the points' mean distance from where they were seen."""
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
    """A copy of the reconstruction by as many cameras as there are parts."""
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
