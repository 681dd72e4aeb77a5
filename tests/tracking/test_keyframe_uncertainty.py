"""What a tracker says of how well it knows its keyframes."""

import numpy as np
import pytest

from geogs.tracking import keyframe_uncertainty as room
from geogs.tracking.keyframe_uncertainty import (
    COMMON_ERRORS,
    RESIDUAL_POWER,
    USUAL_RESIDUAL,
    KeyframeUncertainty,
    keyframe_uncertainty,
)
from planted_walk import drift, planted_tracker


def measured(count: int):
    """A tracker at the truth whose neighbours are matched."""
    tracker, _ = planted_tracker(count)
    near = [(a, b) for a in range(count) for b in range(a + 1, min(a + 4, count))]
    tracker.map.graph.measure(near)
    return tracker


def test_the_ends_of_a_walk_without_loops_are_known_least():
    found = keyframe_uncertainty(measured(14))
    assert found.keyframes == tuple(range(14))
    for deviation in (found.position, found.rotation):
        assert min(deviation[0], deviation[13]) > 1.2 * deviation.min() > 0
    assert np.isfinite(found.depth).all()
    assert 1.0 < float(np.median(found.residual)) < 1.4  # of a norm in two dimensions: 1.18


def test_a_bent_walk_strains_its_matches():
    tracker = measured(14)
    before = keyframe_uncertainty(tracker)
    drift(tracker, scale=0.3, yaw=0.4)
    after = keyframe_uncertainty(tracker)
    assert float(np.median(after.residual)) > float(np.median(before.residual)) + 0.5


def test_parts_of_a_long_walk_follow_each_other(monkeypatch):
    tracker = measured(14)
    whole = keyframe_uncertainty(tracker)
    monkeypatch.setattr(room, "TOGETHER", 5)
    parts = keyframe_uncertainty(tracker)
    assert parts.position[0] == parts.rotation[0] == 0
    assert parts.position[13] > 1.5 * parts.position[4] > 0
    assert np.isfinite(parts.position).all()
    assert (np.diff(parts.position[1:]) > -0.5 * parts.position[1:-1]).all()
    assert parts.position[4:].max() >= 0.5 * whole.position[4:].max()


def test_strain_makes_deviations_larger():
    tracker = measured(6)
    one = np.ones(6)
    calm = KeyframeUncertainty(tuple(range(6)), one, one, one, 0.5 * USUAL_RESIDUAL * one)
    strained = KeyframeUncertainty(tuple(range(6)), one, one, one, 2 * USUAL_RESIDUAL * one)
    assert calm.calibrated(tracker).position == pytest.approx(COMMON_ERRORS * one)
    found = strained.calibrated(tracker)
    assert found.position == pytest.approx(COMMON_ERRORS * 2.0**RESIDUAL_POWER * one)
    assert found.depth == pytest.approx(2 * one)
    assert found.timestamps == pytest.approx([k.timestamp for k in tracker.keyframes])


def test_without_matches_nothing_is_known():
    tracker, _ = planted_tracker(5)
    found = keyframe_uncertainty(tracker)
    assert (found.position == np.inf).all()
    assert (found.depth == np.inf).all()
