"""OpenCV's lens distortion: from rays to the pixels of an image as it came, and back."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from geogs.geometry.camera import Camera

_POLISHING = 8
"""Corrections after OpenCV's own few, which leave errors that an image can show."""


def distorted_pixels(
    rays: Float[np.ndarray, "n 2"], camera: Camera, distortion: Sequence[float]
) -> Float[np.ndarray, "n 2"]:
    """Where rays x/z, y/z are seen in the image of a lens.

    ``camera`` is its pinhole part; ``distortion`` holds OpenCV's coefficients
    k1, k2, p1, p2(, k3(, k4, k5, k6)), none of them for a pinhole.
    """
    if not any(distortion):
        return rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    coefficients = np.array(distortion, dtype=np.float64)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), _matrix(camera), coefficients)
    return pixels[:, 0]


def undistorted_rays(
    pixels: Float[np.ndarray, "n 2"], camera: Camera, distortion: Sequence[float]
) -> Float[np.ndarray, "n 2"]:
    """The rays x/z, y/z that pixels of a lens's image see: the inverse of the above."""
    if not any(distortion):
        return (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    coefficients = np.array(distortion, dtype=np.float64)
    points = np.ascontiguousarray(pixels, dtype=np.float64)[:, None]
    rays = cv2.undistortPoints(points, _matrix(camera), coefficients)[:, 0]
    for _ in range(_POLISHING):
        rays = rays + (pixels - distorted_pixels(rays, camera, distortion)) / (camera.fx, camera.fy)
    return rays


def _matrix(camera: Camera) -> Float[np.ndarray, "3 3"]:
    return camera.matrix().numpy()
