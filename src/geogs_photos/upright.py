"""Vertical direction of the world of photographs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs_photos.pycolmap_library import load_colmap

LEAST_SPREAD = 0.05
"""Least second eigenvalue of the cameras' x axes with which they determine the vertical."""


def make_upright(model: Any, images: Sequence[Any], quarter_turns: Sequence[int]) -> None:
    """Rotate a reconstruction in place, so that y points down in its pictures."""
    colmap = load_colmap()
    R_cw = np.stack([image.cam_from_world().rotation.matrix() for image in images])
    rotation = colmap.Rotation3d(upright_rotation(R_cw, quarter_turns))
    model.transform(colmap.Sim3d(1.0, rotation, np.zeros(3)))


def upright_rotation(
    R_cw: Float64[np.ndarray, "n 3 3"], quarter_turns: Sequence[int]
) -> Float64[np.ndarray, "3 3"]:
    """The rotation of the world after which y points down, as in an upright image.

    Most photographs are level: the x axes of the upright pictures are horizontal, and the vertical
    is the direction most nearly perpendicular to all of them. If all cameras look the same way, the
    mean of their y axes is used. The first camera looks along z as nearly as possible.

    Args:
        R_cw: world to camera of each picture.
        quarter_turns: clockwise, from each picture as it is stored to the upright one.
    """
    turned = np.stack([_turn(k) @ R for k, R in zip(quarter_turns, R_cw, strict=True)])
    x_axes = turned[:, 0]
    y_axes = turned[:, 1]
    values, vectors = np.linalg.eigh(x_axes.T @ x_axes / len(x_axes))
    mean_down = y_axes.mean(0)
    down = vectors[:, 0] if values[1] > LEAST_SPREAD else mean_down
    if down @ mean_down < 0:
        down = -down
    length = np.linalg.norm(down)
    down = down / length if length > 1e-6 else y_axes[0]
    forward = turned[0, 2] - down * (down @ turned[0, 2])
    if np.linalg.norm(forward) < 1e-3:  # the first one looks straight up or down
        forward = turned[0, 1] - down * (down @ turned[0, 1])
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(down, forward), down, forward])


def _turn(quarter_turns: int) -> Float64[np.ndarray, "3 3"]:
    """Rotation from the axes of a stored picture to those of the upright one, turned clockwise."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.linalg.matrix_power(quarter, quarter_turns % 4)
