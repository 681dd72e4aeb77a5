"""Packed edges read like plain ones, and a long walk is adjusted on them in little memory."""

import resource
from dataclasses import replace

import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.loop.global_bundle import global_bundle
from geogs.loop.keyframe_matches import GLOBAL_OPTIONS
from geogs.tracking.graph import frame_graph
from geogs.world.edges import PackedEdge, edge_matches, position_step
from planted_walk import SMALL, drift, planted_tracker


def test_a_packed_edge_tells_the_same():
    tracker, _ = planted_tracker(4)
    graph = tracker.map.graph
    pairs = [(0, 1), (1, 3)]
    graph.measure(pairs)
    plain = dict(graph.edges)
    graph.measure(pairs, packed=True)
    assert list(plain) == list(graph.edges)
    for e, edge in graph.edges.items():
        assert isinstance(edge, PackedEdge)
        matched = plain[e].weight > 0
        (pixels,), (weight,) = edge_matches(graph.keyframes.grid, [edge])
        far = (pixels - plain[e].pixels).abs()[matched]
        assert float(far.max()) <= 0.51 * position_step(SMALL)
        torch.testing.assert_close(weight, plain[e].weight, rtol=1e-3, atol=0)
        (fell,) = frame_graph._reprojections(graph.keyframes.grid, [edge])
        torch.testing.assert_close(fell, plain[e].reprojection, rtol=0, atol=1e-4)
    state = graph.keyframes[3]
    moved = state.T_cw.clone()
    moved[0, 3] += 0.05
    state.T_cw = moved
    assert graph.stale(pairs, 0.5) == [(1, 3)]
    assert graph.stale(pairs, 5.0) == []


def test_edges_of_old_keyframes_can_be_taken_out():
    graph = planted_tracker(5)[0].map.graph
    graph.measure([(0, 1), (1, 2), (2, 3), (3, 4)])
    old = graph.retire([2, 3, 4])
    assert set(old) == {(0, 1), (1, 0)}
    assert set(graph.pairs) == {(1, 2), (2, 3), (3, 4)}


def error_cm(tracker, truth) -> float:
    """RMS distance of the camera centres after a similarity."""
    x = se3_inverse(tracker.keyframes.poses(tracker.keyframes.ids))[:, :3, 3]
    y = se3_inverse(truth)[:, :3, 3]
    scale, R, t = umeyama(x, y)
    return 100 * float((scale * x @ R.T + t - y).square().sum(1).mean().sqrt())


def peak_mib() -> float:
    """Most memory that the process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.long
@pytest.mark.system
def test_a_walk_of_a_thousand_keyframes_is_adjusted_in_little_memory(monkeypatch):
    tiny = Camera(fx=45.0, fy=45.0, cx=23.5, cy=19.5, width=48, height=40)
    options = replace(GLOBAL_OPTIONS, iterations=1)
    for name, value in (("ROUNDS", 1), ("GLOBAL_OPTIONS", options), ("PAIRS", 4)):
        monkeypatch.setattr(f"geogs.loop.keyframe_matches.{name}", value)
    tracker, truth = planted_tracker(1000, tiny, 0.02)
    drift(tracker, scale=0.004)
    before, held = error_cm(tracker, truth), peak_mib()
    global_bundle(tracker)
    assert len(tracker.map.graph.edges) == 8000
    assert before > 2.0
    assert error_cm(tracker, truth) < 0.5 * before
    # A dense camera system alone is 274 MiB, the distances of all pairs are more.
    assert peak_mib() - held < 200
