"""Clocks of given poses: units by their overlap, offsets by the turning of the camera."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.errors import InputError
from geogs.io.sources.pose_clock import Turning, on_clock
from geogs.types import Trajectory

OFFSETS = [1_700_000_000.0, -3.25, 12.5]


def orientation(times, seed=0):
    """A camera that turns irregularly about all axes."""
    rng = np.random.default_rng(seed)
    angles = np.zeros((len(times), 3))
    for frequency in (0.31, 0.7, 1.3):
        phase, size = rng.uniform(0, 6, 3), rng.uniform(0.03, 0.15, 3)
        angles += size * np.sin(2 * np.pi * frequency * times[:, None] + phase)
    return Rotation.from_euler("yxz", angles)


def poses(times, clock, seed=0):
    """The camera's poses at ``times``, whose file gives ``clock(times)``."""
    T_wc = np.tile(np.eye(4), (len(times), 1, 1))
    T_wc[:, :3, :3] = orientation(times, seed).as_matrix()
    return Trajectory(clock(times), T_wc, np.ones(len(times), dtype=bool))


def images(first, last, noise=0.02, seed=0):
    """Measured turning of the rays at 30 images a second."""
    times = np.arange(first, last, 1 / 30)
    turned = orientation(times, seed)
    rates = (turned[1:].inv() * turned[:-1]).as_rotvec() * 30
    middle = (times[:-1] + times[1:]) / 2
    return Turning(middle, rates + np.random.default_rng(9).normal(0, noise, rates.shape))


def never():
    raise AssertionError("clocks that agree need no images")


def test_poses_that_share_the_time_stay():
    given = poses(np.arange(0, 8, 0.1), lambda t: t)
    found, change = on_clock(given, 0.0, 8.0, never, "a.tum")
    assert found is given
    assert change == ""


@pytest.mark.parametrize(("unit", "word"), [(1e3, "milliseconds"), (1e9, "nanoseconds")])
def test_other_units_are_recognised(unit, word):
    for begin in (0.01, 0.0):
        given = poses(np.arange(0, 8, 1 / 30), lambda t, begin=begin: (t + begin) * unit)
        found, change = on_clock(given, 0.0, 8.0, never, "a.tum")
        assert word in change
        np.testing.assert_allclose(found.timestamps[:3], begin + np.arange(3) / 30)


def test_sparse_poses_that_begin_with_the_images_are_in_seconds():
    given = poses(np.arange(0.0, 60.0, 5.0), lambda t: t)
    found, change = on_clock(given, 0.0, 60.0, never, "a.tum")
    assert found is given
    assert change == ""


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("rate", [10.0, 100.0])
def test_an_offset_is_found_by_the_turning(offset, rate):
    """The poses begin two seconds before the images and end one after, or within them."""
    for begin, end in ((-2.0, 9.0), (0.5, 7.0)):
        given = poses(np.arange(begin, end, 1 / rate), lambda t: t + offset + 20.0)
        found, change = on_clock(given, 0.0, 8.0, lambda: images(0.0, 8.0), "a.tum")
        assert "by the turning" in change
        assert found.timestamps[0] == pytest.approx(begin, abs=0.02)


def test_a_camera_that_hardly_turns_needs_equal_spans():
    times = np.arange(0, 8, 1 / 30)
    still = Trajectory(times + 500, np.tile(np.eye(4), (len(times), 1, 1)), times >= 0)
    calm = Turning(np.linspace(0, 8, 200), np.full((200, 3), 0.001))
    found, change = on_clock(still, 0.0, 8.0, lambda: calm, "a.tum")
    assert "equally long" in change
    assert found.timestamps[0] == pytest.approx(0.0)
    with pytest.raises(InputError, match=r"a.tum: no pose is at the time of an image"):
        on_clock(still, 0.0, 5.0, lambda: calm, "a.tum")


def test_poses_of_another_video_are_refused():
    other = poses(np.arange(0, 8, 1 / 30), lambda t: t + 100, seed=4)
    with pytest.raises(InputError, match=r"those of the images 0[.]00 to 8[.]00 s"):
        on_clock(other, 0.0, 8.0, lambda: images(0.0, 8.0), "a.tum")


def test_poses_with_an_unset_time_are_refused():
    given = poses(np.arange(0, 8, 1 / 30), lambda t: np.where(t > 0, t + 1.7e9, -1.0))
    with pytest.raises(InputError, match=r"its times are -1[.]00 to"):
        on_clock(given, 0.0, 8.0, lambda: images(0.0, 8.0), "a.tum")
