"""OpenCV's lens: against its formula written out, and there and back."""

import math

import cv2
import numpy as np
import pytest

from geogs.camera.distortion import RESAMPLING, lens_maps
from geogs.geometry.camera import FISHEYE_LIMIT, Camera
from lenses import distorted_pixels, undistorted_rays, with_lens

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


@pytest.mark.parametrize("distortion", [(), 4 * (0.0,), (-0.3, 0.1, 0.001, 0.002), (0.15, 0, 0, 0)])
def test_there_and_back(distortion):
    distortion = tuple(map(float, distortion))
    pixels = distorted_pixels(RAYS, CAMERA, distortion)
    np.testing.assert_allclose(undistorted_rays(pixels, CAMERA, distortion), RAYS, atol=1e-6)


FISHEYES = [(), (-0.02, 0.004, -0.003, 0.0007), (0.1, -0.05, 0.02, -0.004)]


@pytest.mark.parametrize("k", FISHEYES)
def test_pixels_of_a_fisheye_follow_the_formula(k):
    rays = np.concatenate([RAYS, [[4.0, -3.0], [0.0, 1.2], [1e-14, 0.0]]])
    pixels = distorted_pixels(rays, CAMERA, k, "fisheye")
    for (x, y), pixel in zip(rays, pixels, strict=True):
        angle = math.atan(math.hypot(x, y))
        radius = angle + sum(c * angle ** (2 * n + 3) for n, c in enumerate(k))
        way = math.atan2(y, x)
        expected = [500 * radius * math.cos(way) + 321, 490 * radius * math.sin(way) + 237]
        np.testing.assert_allclose(pixel, expected, atol=1e-9)


@pytest.mark.parametrize("k", FISHEYES)
def test_pixels_of_a_fisheye_are_those_of_opencv(k):
    points = np.concatenate([RAYS, np.ones((len(RAYS), 1))], axis=1)[:, None]
    K, D = CAMERA.matrix().numpy(), np.array(k or (0.0,) * 4)
    expected, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, D)
    found = distorted_pixels(RAYS, CAMERA, k, "fisheye")
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("k", FISHEYES)
def test_there_and_back_by_a_fisheye(k):
    rays = np.concatenate([RAYS, [[1.5, -1.0], [0.0, 2.0]]])
    pixels = distorted_pixels(rays, CAMERA, k, "fisheye")
    np.testing.assert_allclose(undistorted_rays(pixels, CAMERA, k, "fisheye"), rays, atol=1e-9)


def test_what_a_fisheye_sees_behind_itself_is_given_at_the_limit():
    pixels = np.array([[321 + 500 * 1.8, 237.0], [321.0, 237 - 490 * 2.5]])
    angles = np.arctan(np.linalg.norm(undistorted_rays(pixels, CAMERA, (), "fisheye"), axis=1))
    np.testing.assert_allclose(angles, FISHEYE_LIMIT, atol=1e-9)


@pytest.mark.parametrize(
    "distortion", [(), (-0.2, 0.06, 0.002, -0.003), (-0.1, 0.02, 0.0, 0.0, 0.01)]
)
def test_maps_say_where_the_lens_shows_what_a_pinhole_does(distortion):
    u, v = lens_maps(CAMERA, with_lens(CAMERA, distortion))
    for row, column in [(0, 0), (237, 321), (100, 500), (479, 639)]:
        ray = np.array([[(column - 321) / 500, (row - 237) / 490]])
        (seen,) = distorted_pixels(ray, CAMERA, distortion)
        np.testing.assert_allclose([u[row, column], v[row, column]], seen, atol=1e-3)


def misplaced(how: int, period: int) -> float:
    """Pixels, root mean square over fractions of one, by which waves are shown beside their place
    when an image is resampled; their places are told by their phases."""
    v, u = np.mgrid[:16, : 12 * period].astype(np.float32)
    wave = np.exp(2j * np.pi * u / period)
    image, inner = (128 + 100 * wave.imag).astype(np.float32), np.s_[4:-4, period:-period]
    shifts = np.linspace(0, 1, 32, endpoint=False, dtype=np.float32)
    shown = (cv2.remap(image, u + s, v, how)[inner] - 128 for s in shifts)
    phases = [np.angle((row * wave.conj()[inner]).mean() * 2j) for row in shown]
    return float(np.std(np.array(phases) * period / (2 * np.pi) - shifts))


@pytest.mark.parametrize("period", [6, 10, 20, 40])
def test_straight_images_show_things_at_their_place(period):
    assert misplaced(RESAMPLING, period) < 0.01
    assert misplaced(cv2.INTER_CUBIC, period) > 0.017  # why it is not taken
