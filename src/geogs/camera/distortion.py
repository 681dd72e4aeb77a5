"""Maps from the pixels of a pinhole to those of a lens, and what is usual of lenses."""

from typing import Literal

import cv2
import numpy as np

from geogs.geometry.camera import Camera

LensModel = Literal["polynomial", "fisheye"]
USUAL_BEND = 0.1, 0.2
"""Prior standard deviations of k1 and k2 of an uncalibrated polynomial lens."""
RESAMPLING = cv2.INTER_LANCZOS4
"""Interpolation of straightened images. OpenCV's cubic (a = -3/4, which does not preserve a slope)
would shift image content by up to 0.04 pixels, most at a quarter of a pixel; the offsets of a
rolling shutter's rows pass through all such fractions."""


def lens_maps(target: Camera, source: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return column and row in the image of a lens, ``source``, for each pixel of a pinhole,
    ``target``; float32. OpenCV computes them faster than :class:`Camera`."""
    size = (target.width, target.height)
    if source.is_fisheye:
        D = np.array([source.k1, source.k2, source.k3, source.k4])
        init = cv2.fisheye.initUndistortRectifyMap
        maps = init(source.K, D, np.eye(3), target.K, size, cv2.CV_32FC1)
    else:
        D = np.array(source.distortion)
        maps = cv2.initUndistortRectifyMap(source.K, D, None, target.K, size, cv2.CV_32FC1)
    return maps[0], maps[1]
