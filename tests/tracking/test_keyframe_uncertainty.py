"""What a tracker says of how well it knows its keyframes."""

import numpy as np
import pytest
import torch

from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty import lens_error, marginals
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.tracking import keyframe_uncertainty as room
from geogs.tracking.keyframe_uncertainty import (
    USUAL_RESIDUAL,
    KeyframeUncertainty,
    keyframe_uncertainty,
)
from planted_walk import drift, planted_tracker

EXACT = BundleOptions(iterations=10, huber=50.0)


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


def test_errors_that_all_matches_have_in_common_are_foretold(monkeypatch):
    """Errors of either half of the image in all keyframes, several times as large as usual."""
    flow_size, place_size = 0.5, 1.0
    monkeypatch.setattr(lens_error, "PRIOR", (1e-9, 1e-9, 1e-9))  # the lens is known
    monkeypatch.setattr(marginals, "PLACES", (2, 1))
    monkeypatch.setattr(marginals, "COMMON_FLOW", flow_size)
    monkeypatch.setattr(marginals, "COMMON_PLACE", place_size)
    camera = Camera(fx=150.0, fy=150.0, cx=79.5, cy=55.5, width=160, height=112)
    squares = []
    for seed in range(4):
        tracker, T = planted_tracker(14, camera, sigma=0.05)
        near = [(a, b) for a in range(14) for b in range(a + 1, min(a + 4, 14))]
        tracker.map.graph.measure(near)
        g = torch.Generator().manual_seed(seed)
        flow, place = (s * torch.randn(2, 2, generator=g) for s in (flow_size, place_size))
        at = (tracker.keyframes.grid.pixels[:, 0] / camera.width * 2).long()
        for (i, j), edge in tracker.map.graph.edges.items():
            edge.pixels += 0.05 * (np.sign(j - i) * flow[at] + place[at])
        ids = list(range(14))
        tracker.map.graph.adjust(list(tracker.map.graph.edges), ids[1:], ids, EXACT)
        found, truth = (se3_inverse(poses)[:, :3, 3] for poses in (tracker.keyframes.poses(ids), T))
        scale, R, t = umeyama(found, truth)
        error = (found - (truth - t) @ R / scale).norm(dim=1)
        said = torch.from_numpy(keyframe_uncertainty(tracker).position)
        squares.append((error.square().mean() / said.square().mean()).item())
    assert 0.5 < np.sqrt(np.mean(squares)) < 1.2


def test_depths_are_as_unsure_as_lens_and_common_errors_leave_them(monkeypatch):
    tracker = measured(14)
    unsure = keyframe_uncertainty(tracker).depth
    monkeypatch.setattr(lens_error, "PRIOR", (1e-9, 1e-9, 1e-9))
    lens_known = keyframe_uncertainty(tracker).depth
    monkeypatch.setattr(marginals, "COMMON_FLOW", 0.0)
    monkeypatch.setattr(marginals, "COMMON_PLACE", 0.0)
    own = keyframe_uncertainty(tracker).depth
    assert (unsure > lens_known).all()
    assert (lens_known > own).all()
    matches = room._Matches.among(tracker, list(range(14)))
    assert matches is not None
    alone = marginals.marginals(matches.grid, matches.problem, room.OPTIONS, room.CELLS)
    assert own == pytest.approx(alone.depth_deviation.numpy())


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
    assert calm.calibrated(tracker).position == pytest.approx(one)
    found = strained.calibrated(tracker)
    assert found.position == pytest.approx(2 * one)
    assert found.depth == pytest.approx(2 * one)
    assert found.timestamps == pytest.approx([k.timestamp for k in tracker.keyframes])


def test_without_matches_nothing_is_known():
    tracker, _ = planted_tracker(5)
    found = keyframe_uncertainty(tracker)
    assert (found.position == np.inf).all()
    assert (found.depth == np.inf).all()
