"""How far the poses of pictures explain the matches between them, whatever points these made."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.geometry.epipolar import epipolar_distance, homogeneous
from geogs_photos.pycolmap_library import load_colmap

MAX_ERROR = 4.0
"""Pixels that a match may be from its epipolar line."""


def agreement(model: Any, database: Path, pictures: Collection[int]) -> dict[int, float]:
    """Part of each picture's verified matches with the other pictures that their poses explain.

    Those are matches that one motion of the camera explains, found without any pose; 0 where there
    are none.
    """
    opened = load_colmap().Database.open(database)
    kept, agreeing = dict.fromkeys(pictures, 0), dict.fromkeys(pictures, 0)
    try:
        ids, _ = opened.read_two_view_geometry_num_inliers()
        rays = {n: _rays(model, opened, n) for n in pictures}
        for one, other in (load_colmap().pair_id_to_image_pair(i) for i in ids):
            if one not in rays or other not in rays:
                continue
            matches = opened.read_two_view_geometry(one, other).inlier_matches
            first, second = (_pose(model, n) for n in (one, other))
            focal = model.cameras[model.images[one].camera_id].mean_focal_length()
            off = focal * epipolar_distance(
                second @ np.linalg.inv(first), np.eye(3),
                rays[one][matches[:, 0]], rays[other][matches[:, 1]],
            )  # fmt: skip
            for n in (one, other):
                kept[n] += len(matches)
                agreeing[n] += int((off <= MAX_ERROR).sum())
    finally:
        opened.close()
    return {n: agreeing[n] / max(kept[n], 1) for n in pictures}


def _pose(model: Any, number: int) -> Float64[np.ndarray, "4 4"]:
    """World to camera of a picture."""
    T = np.eye(4)
    T[:3] = model.images[number].cam_from_world().matrix()
    return T


def _rays(model: Any, opened: Any, number: int) -> Float64[np.ndarray, "n 3"]:
    """Keypoints of a picture through the camera's lens, at depth 1."""
    camera = model.cameras[model.images[number].camera_id]
    pixels = np.asarray(opened.read_keypoints(number), np.float64)[:, :2]
    return homogeneous(np.asarray(camera.cam_from_img(pixels), np.float64)[:, :2])
