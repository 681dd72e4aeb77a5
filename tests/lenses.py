"""Cameras with OpenCV's coefficients as they stand in calibrations."""

from collections.abc import Sequence

import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration

LENSES = {
    "pinhole": {},
    "radial": {"k1": 0.08, "k2": -0.1},
    "brown": {"k1": -0.12, "k2": 0.03, "p1": 0.01, "p2": -0.008, "k3": 0.02},
    "rational": {"k1": 0.3, "k2": 0.1, "p1": 0.002, "k3": 0.02, "k4": 0.35, "k5": 0.2, "k6": 0.03},
    "fisheye": {"k1": -0.02, "k2": 0.004, "k3": -0.003, "k4": 0.0007, "is_fisheye": True},
}
"""Coefficients of one camera of each model."""


def with_lens(camera: Camera, distortion: Sequence[float], lens: str = "polynomial") -> Camera:
    """The camera with a lens."""
    numbers = camera.fx, camera.fy, camera.cx, camera.cy, tuple(distortion)
    return Calibration(*numbers, camera.width, camera.height, lens=lens).camera()


def distorted_pixels(rays, camera, distortion, lens="polynomial") -> np.ndarray:
    """Pixels of rays x / z, y / z."""
    return with_lens(camera, distortion, lens).pixels(torch.from_numpy(rays)).numpy()


def undistorted_rays(pixels, camera, distortion, lens="polynomial") -> np.ndarray:
    """Rays x / z, y / z of pixels."""
    return with_lens(camera, distortion, lens).plane(torch.from_numpy(pixels)).numpy()
