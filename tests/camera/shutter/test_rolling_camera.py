"""When a pixel is seen, upright or turned; rays of a lens."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.geometry.camera import Camera
from geogs.io.sources.formats.video_file import turn_upright
from lenses import with_lens

LANDSCAPE = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
PORTRAIT = Camera(50.0, 50.0, 23.5, 31.5, 48, 64)


def test_first_and_last_row_are_a_readout_apart():
    rolling = RollingCamera(LANDSCAPE)
    times = rolling.line_times(np.array([[0.0, 0.0], [63.0, 47.0], [10.0, 23.5]]))
    np.testing.assert_allclose(times, [-0.5, 0.5, 0.0], atol=1e-12)


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_a_turned_image_keeps_the_times_of_its_lines(quarter_turns):
    """Each pixel carries the number of the line it was read in, and is turned with the image."""
    lines = np.repeat(np.arange(48, dtype=np.uint8)[:, None, None], 64, 1).repeat(3, 2)
    upright = turn_upright(lines, quarter_turns)
    height, width = upright.shape[:2]
    camera = PORTRAIT if quarter_turns % 2 else LANDSCAPE
    assert (camera.width, camera.height) == (width, height)
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u.ravel(), v.ravel()], 1).astype(float)
    times = RollingCamera(camera, quarter_turns=quarter_turns).line_times(pixels)
    np.testing.assert_allclose(times, upright[..., 0].ravel() / 47.0 - 0.5, atol=1e-12)


def test_a_smaller_image_keeps_the_times_of_the_sensors_lines():
    """Line 0 of a third of the size is the mean of the sensor's lines 0, 1 and 2."""
    small = RollingCamera(LANDSCAPE.resized(21, 16), lines=48)
    times = small.line_times(np.array([[0.0, 0.0], [0.0, 15.0]]))
    np.testing.assert_allclose(times, [1 / 47 - 0.5, 46 / 47 - 0.5], atol=1e-12)


def test_rays_are_the_inverse_of_pixels():
    rolling = RollingCamera(with_lens(LANDSCAPE, (-0.2, 0.05, 0.001, 0.0)))
    pixels = np.array([[0.0, 0.0], [63.0, 47.0], [20.0, 40.0]])
    rays = rolling.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(rolling.pixels(3 * rays), pixels, atol=1e-6)
    pinhole = replace(rolling, camera=LANDSCAPE)
    np.testing.assert_allclose(pinhole.pixels(pinhole.rays(pixels)), pixels, atol=1e-9)
