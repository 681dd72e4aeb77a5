"""Cameras with OpenCV's coefficients as they stand in calibrations."""

from collections.abc import Sequence

import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration


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
