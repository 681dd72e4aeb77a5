"""OpenCV's lens: against its formula written out, and there and back."""

import numpy as np
import pytest

from geogs.geometry.camera import Camera
from geogs.geometry.distortion import distorted_pixels, undistorted_rays

CAMERA = Camera(500.0, 490.0, 321.0, 237.0, 640, 480)
RAYS = np.array([[0.0, 0.0], [0.3, 0.2], [-0.35, 0.1], [0.1, -0.3], [0.55, 0.4]])


def test_pixels_follow_the_formula():
    k1, k2, p1, p2, k3 = -0.2, 0.06, 0.002, -0.003, 0.01
    pixels = distorted_pixels(RAYS, CAMERA, (k1, k2, p1, p2, k3))
    for (x, y), pixel in zip(RAYS, pixels, strict=True):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        np.testing.assert_allclose(pixel, [500 * u + 321, 490 * v + 237], atol=1e-9)


@pytest.mark.parametrize("distortion", [(), (0.0, 0.0), (-0.3, 0.1, 0.001, 0.002), (0.15, 0, 0, 0)])
def test_there_and_back(distortion):
    distortion = tuple(map(float, distortion))
    pixels = distorted_pixels(RAYS, CAMERA, distortion)
    np.testing.assert_allclose(undistorted_rays(pixels, CAMERA, distortion), RAYS, atol=1e-6)
