"""The turning at each image, wherever reading begins, and images without it."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.camera.shutter.neighbours import with_angular_motion
from geogs.camera.shutter.rolling_camera import RollingCamera
from rolling_scenes import RATE, READOUT, hand_held, rolling_frames
from tracking_scenes import CAMERA

ROLLING = RollingCamera(CAMERA)


@pytest.fixture(scope="module")
def video():
    return rolling_frames(hand_held, 7)


def turnings(frames, wanted=lambda position: True):
    return {
        frame.index: np.concatenate([turning.rate, turning.acceleration])
        for frame, turning in with_angular_motion(frames, ROLLING, READOUT, wanted)
    }


def test_ends_have_one_side_and_others_the_mean_of_both(video):
    found = turnings(video)
    assert list(found) == list(range(7))
    first, second = found[0][:3], 2 * found[1][:3] - found[0][:3]
    np.testing.assert_allclose(found[1][3:], (second - first) * RATE, atol=1e-6)
    assert not found[0][3:].any()
    assert not found[6][3:].any()
    assert np.linalg.norm(found[3][:3]) > 0.3


def test_what_is_found_does_not_depend_on_where_reading_begins(video):
    whole = turnings(video)
    later = turnings(video[2:], lambda position: position > 0)
    assert list(later) == [3, 4, 5, 6]
    every_other = turnings(video, lambda position: position % 3 == 1)
    assert list(every_other) == [1, 4]
    for part in (later, every_other):
        for index, turning in part.items():
            np.testing.assert_array_equal(turning, whole[index])


def test_beside_an_image_that_cannot_be_read_the_other_side_tells(video):
    class Missing:
        index, timestamp, image = 3, video[3].timestamp, None

    whole = turnings(video)
    found = turnings([*video[:3], Missing(), *video[4:]])
    assert list(found) == list(range(7))
    assert not found[3].any()
    assert not found[2][3:].any()
    np.testing.assert_array_equal(found[1], whole[1])
    np.testing.assert_array_equal(found[5], whole[5])


def test_images_of_the_same_time_tell_nothing(video):
    frozen = [replace(video[0], index=k, timestamp=0.0) for k in range(3)]
    assert not any(t.any() for t in turnings(frozen).values())
    assert turnings([]) == {}
    assert not turnings(video[:1])[0].any()
