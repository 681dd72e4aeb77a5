"""How far the poses of pictures explain the matches between them, whatever points these made."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

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
            T = (model.images[n].cam_from_world() for n in (one, other))
            first, second = (pose.matrix() for pose in T)
            R = second[:, :3] @ first[:, :3].T
            t = second[:, 3] - R @ first[:, 3]
            focal = model.cameras[model.images[one].camera_id].mean_focal_length()
            off = focal * epipolar_distance(
                rays[one][matches[:, 0]], rays[other][matches[:, 1]], R, t
            )
            for n in (one, other):
                kept[n] += len(matches)
                agreeing[n] += int((off <= MAX_ERROR).sum())
    finally:
        opened.close()
    return {n: agreeing[n] / max(kept[n], 1) for n in pictures}


def epipolar_distance(
    first: Float64[np.ndarray, "n 2"],
    second: Float64[np.ndarray, "n 2"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "n"]:
    """Sampson's distance of matches from the epipolar geometry of two cameras, focal length 1.

    Where the cameras are in one place, the distance of the second point from where the rotation
    takes the first.
    """
    x, y = (np.column_stack([p, np.ones(len(p))]) for p in (first, second))
    turned = x @ R.T
    if np.linalg.norm(t) < 1e-12:
        return np.linalg.norm(second - turned[:, :2] / turned[:, 2:], axis=1)
    E = np.cross(np.eye(3), t) @ R
    line, back = x @ E.T, y @ E
    length = np.hypot(np.linalg.norm(line[:, :2], axis=1), np.linalg.norm(back[:, :2], axis=1))
    return np.abs((y * line).sum(1)) / np.maximum(length, 1e-12 * np.linalg.norm(t))


def _rays(model: Any, opened: Any, number: int) -> Float64[np.ndarray, "n 2"]:
    """Keypoints of a picture through the camera's lens, at depth 1."""
    camera = model.cameras[model.images[number].camera_id]
    pixels = np.asarray(opened.read_keypoints(number), np.float64)[:, :2]
    rays = camera.cam_from_img(pixels)
    return np.asarray(rays, np.float64)[:, :2]
