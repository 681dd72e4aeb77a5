"""Working images that are a part of the stored ones."""

import numpy as np
import pytest

from geogs.io.sources.calibration import Calibration
from geogs.io.sources.undistort import Rectifier, Window, window_around


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.0, 0.0)])
def test_a_window_is_the_same_image_cut(distortion):
    """The part has the pixels and the rays that it has within the whole."""
    image = np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)
    calibration = Calibration(120.0, 121.0, 80.3, 44.1, distortion, 160, 90)
    whole = Rectifier(calibration, 0)
    window = Window(0.25, 0.1, 0.75, 0.9)
    part = Rectifier(calibration, 0, window=window)
    assert (part.camera.width, part.camera.height) == (80, 72)
    np.testing.assert_array_equal(part(image), whole(image)[9:81, 40:120])
    assert part.camera.cx == pytest.approx(whole.camera.cx - 40)
    assert part.camera.cy == pytest.approx(whole.camera.cy - 9)
    assert part.camera.fx == whole.camera.fx


def test_the_longer_side_is_that_of_the_window():
    calibration = Calibration(1000.0, 1000.0, 959.5, 539.5, (), 1920, 1080)
    portrait = window_around(np.pad(np.ones((1080, 608), bool), ((0, 0), (656, 656))))
    part = Rectifier(calibration, 512, window=portrait)
    assert (part.camera.width, part.camera.height) == (288, 512)
    assert part.camera.cx == pytest.approx(143.5, abs=0.6)
    assert window_around(np.ones((1080, 1920), bool)) is None
