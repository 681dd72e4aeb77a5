"""Adjustment of all keyframes: what a long way in one direction leaves of a drift of scale."""

import pytest
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.loop import keyframe_matches
from geogs.loop.global_bundle import global_bundle
from geogs.tracking.tracker import Tracker
from planted_walk import drift, planted_tracker

WAY = 90
"""Keyframes one way."""


def error(tracker: Tracker, truth: Tensor) -> float:
    """Root mean square of what is left of the centres' errors after a similarity, metres."""
    x = se3_inverse(tracker.keyframes.poses(list(range(WAY))))[:, :3, 3]
    y = se3_inverse(truth[:WAY])[:, :3, 3]
    scale, R, t = umeyama(x, y)
    return float((scale * x @ R.T + t - y).square().sum(1).mean().sqrt())


def test_slow_drift_of_scale_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """3 mm are left of 39, where a damping of 1e-4 of the diagonal leaves 19."""
    monkeypatch.setattr(keyframe_matches, "PAIRS", 3)  # neighbours alone, as on a street
    tracker, truth = planted_tracker(2 * WAY, sigma=0.03)
    drift(tracker, 0.2)
    assert error(tracker, truth) > 0.03
    for id in range(WAY, 2 * WAY):
        tracker.keyframes.remove(id)
    global_bundle(tracker)
    assert error(tracker, truth) < 0.006
