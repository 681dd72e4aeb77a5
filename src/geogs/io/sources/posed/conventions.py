"""Common mistakes in pose conventions, and the correction of each.

Mistakes that change nothing in the images, such as a rotated world, are not included.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Poses = Float64[np.ndarray, "n 4 4"]


@dataclass(frozen=True, slots=True)
class Convention:
    """A wrong convention of given poses."""

    name: str
    """Description of such poses."""
    remedy: str
    """Correction by the user."""
    correct: Callable[[Poses], Poses]
    """Map poses as read to correct world-to-camera poses, up to a change of the world."""


def conventions_for(kind: str) -> tuple[Convention, ...]:
    """The mistakes to look for in a format: nerfstudio expects OpenGL axes, all others OpenCV's."""
    return (*(_IN_OPENGL if kind == "nerfstudio" else _IN_OPENCV), *_TURNED)


def _turned_camera(axes: list[list[int]]) -> Callable[[Poses], Poses]:
    """Row k of ``axes``: OpenCV's axis k in the axes of the camera as it was read."""
    T = np.eye(4)
    T[:3, :3] = axes
    return lambda T_cw: T @ T_cw


def _quaternion_order(T_cw: Poses) -> Poses:
    """Camera-to-world quaternions that were written w x y z and read as x y z w."""
    T_wc = np.linalg.inv(T_cw)
    w, x, y, z = Rotation.from_matrix(T_wc[:, :3, :3]).as_quat().T
    T_wc[:, :3, :3] = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    return np.linalg.inv(T_wc)


_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
_OPENGL = _turned_camera([[1, 0, 0], [0, -1, 0], [0, 0, -1]])


def _inverse_and_opengl(T_cw: Poses) -> Poses:
    return _OPENGL(np.linalg.inv(T_cw))


_INVERT = "invert the matrices"
_NEGATE = "negate the second and third column of the camera-to-world matrices"
_INVERT_AND_NEGATE = f"{_INVERT}, then {_NEGATE}"
_INVERSE = "the inverse poses (world to camera for camera to world, or the other way round)"

_IN_OPENCV = (
    Convention("cameras in OpenGL axes (y up, looking along -z)", _NEGATE, _OPENGL),
    Convention(_INVERSE, _INVERT, np.linalg.inv),
    Convention(f"{_INVERSE} in OpenGL axes", _INVERT_AND_NEGATE, _inverse_and_opengl),
)
# The reader has converted the cameras from OpenGL to OpenCV axes already. With inverse poses that
# rotated the world instead, so the conversion of the cameras is needed in the opposite case.
_IN_OPENGL = (
    Convention("cameras in OpenCV axes (y down, looking along +z)", _NEGATE, _OPENGL),
    Convention(f"{_INVERSE} in OpenCV axes", _INVERT_AND_NEGATE, np.linalg.inv),
    Convention(_INVERSE, _INVERT, _inverse_and_opengl),
)
_TURNED = (
    Convention(
        "cameras that look along +y with z up (y and z swapped)",
        "put the columns x, -z, y of the camera-to-world rotations for x, y, z",
        _turned_camera([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    ),
    Convention(
        "cameras that look along -y with z down (y and z swapped)",
        "put the columns x, z, -y of the camera-to-world rotations for x, y, z",
        _turned_camera([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    ),
    Convention(
        "poses of a body that looks along +x with z up",
        "put the columns -y, -z, x of the camera-to-world rotations for x, y, z",
        _turned_camera([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    ),
    Convention(
        "poses of mirrored images",
        "flip the images, left and right",
        lambda T: _MIRROR @ T @ _MIRROR,
    ),
    Convention(
        "poses of the next image each", "move the poses by one row", lambda T: np.roll(T, 1, axis=0)
    ),
    Convention(
        "poses of the image before each",
        "move the poses by one row",
        lambda T: np.roll(T, -1, axis=0),
    ),
    Convention(
        "quaternions in the order w x y z", "move the w column to the end", _quaternion_order
    ),
)
