"""Adjustment of all keyframes: what a long way in one direction leaves of a drift of scale."""

from dataclasses import replace

import pytest
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.loop import global_bundle as adjustment
from geogs.tracking.graph.frame_graph import SURE_DAMPING
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
    monkeypatch.setattr(adjustment, "PAIRS", 3)  # neighbours alone, as on a street
    tracker, truth = planted_tracker(2 * WAY, sigma=0.03)
    drift(tracker, 0.2)
    assert error(tracker, truth) > 0.03
    adjustment.global_bundle(tracker, keyframes=list(range(WAY)))
    assert error(tracker, truth) < 0.006


def test_what_cannot_be_solved_is_damped_more(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, _ = planted_tracker(8)
    graph, tried = tracker.map.graph, []
    solve = graph._solve

    def failing(*args):
        result, ids = solve(*args)
        tried.append(args[-1].damping)
        return replace(result, finite=args[-1].damping >= SURE_DAMPING), ids

    monkeypatch.setattr(graph, "_solve", failing)
    graph.measure([(0, 1), (1, 2)])
    options = replace(adjustment.GLOBAL_OPTIONS, damping=1e-6)
    assert graph.adjust(list(graph.edges), [1, 2], [0, 1, 2], options) is not None
    assert tried == [1e-6, SURE_DAMPING]
