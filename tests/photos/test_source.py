"""The time for the poses of photographs: kept to its part of the whole, or said to be too short."""

import pytest

from geogs.evaluation.duration import duration
from geogs_photos import source
from geogs_photos.source import FEATURES, features_for, seconds_to_find_poses, what_does_not_fit


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr(source, "worker_count", lambda: 2)


def test_fewer_features_are_matched_where_time_is_short():
    assert features_for(50, None) == features_for(50, 300.0) == FEATURES[0]
    for seconds in (70.0, 90.0, 120.0):
        most = features_for(50, seconds)
        assert most in FEATURES[1:]
        assert seconds_to_find_poses(50, most) <= 0.5 * seconds
        assert f"found from {most} features" in what_does_not_fit(50, seconds)
    assert features_for(50, 10.0) == FEATURES[-1]


def test_what_will_not_do_is_said_at_once():
    assert what_does_not_fit(50, None) == what_does_not_fit(50, 300.0) == ""
    said = what_does_not_fit(200, 30.0)
    assert said.startswith("warning: The --budget will not do: the poses of 200 photographs")
    assert f"take about {duration(seconds_to_find_poses(200, FEATURES[-1]))} here" in said
    assert "--budget 130s would do, or --input.stride 2" in said


@pytest.mark.parametrize(("photographs", "took"), [(50, 20.5), (62, 40.0)])
def test_the_poses_of_two_sets_take_about_what_is_said(photographs, took):
    """A statue and a skeleton of half a megapixel and less, on two cores, with fewest features."""
    assert 0.7 < seconds_to_find_poses(photographs, FEATURES[-1]) / took < 1.4
