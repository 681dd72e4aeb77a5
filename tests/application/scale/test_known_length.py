"""What --scale-from may say."""

import pytest

from geogs.application.scale.known_length import (
    CameraHeight,
    KnownDistance,
    KnownDistances,
    SensorScale,
    scale_source,
    sentences_on_poses,
)
from geogs.application.scale.tags import TagSize
from geogs.errors import InputError
from geogs.tracking.graph.measured_odometry import OdometryAgreement


def test_each_kind_is_understood():
    assert scale_source("") is None
    assert scale_source("sensor") == SensorScale()
    assert scale_source("height:1.6") == CameraHeight(1.6)
    assert scale_source("aruco:DICT_5X5_50:0.12") == TagSize("DICT_5X5_50", 0.12)
    one = KnownDistance(12, (100.0, 50.5), (300.0, 60.0), 1.25)
    assert scale_source("12:100,50.5,300,60=1.25m") == KnownDistances((one,))
    two = scale_source("12:100,50.5,300,60=1.25m; 0:1,2,3,4=.5")
    assert two == KnownDistances((one, KnownDistance(0, (1.0, 2.0), (3.0, 4.0), 0.5)))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("lidar", "not understood"), ("height:", "not understood"), ("height:-1", "of -1 m"),
        ("aruco:DICT_5X5_50", "not understood"), ("aruco:DICT_5X5_50:0", "of 0 m"),
        ("1:2,3,4,5", "not understood"), ("1:2,3,2,3=1", "one pixel twice"),
        ("1:2,3,4,5=1;x", "not understood"), (";", "not understood"),
        ("height:1e9", "of 1e[+]09 m"),
    ],
)  # fmt: skip
def test_mistakes_are_told(text, why):
    with pytest.raises(InputError, match=why):
        scale_source(text)


def test_poses_that_do_not_fit_are_told():
    assert sentences_on_poses(OdometryAgreement(0, 0.0, False)) == []
    (used,) = sentences_on_poses(OdometryAgreement(20, 0.85, True))
    assert used == (
        "Poses beside the images: 85% of 20 motions between keyframes fit what the images show."
    )
    (refused,) = sentences_on_poses(OdometryAgreement(20, 0.05, False))
    assert refused.startswith("warning: the poses beside the images are not used: only 5% of 20")
