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
from geogs.tracking.keyframe_uncertainty import USUAL_RESIDUAL, keyframe_uncertainty, misfit
from geogs.types import FoundLens
from planted_walk import drift, planted_tracker

EXACT = BundleOptions(iterations=10, huber=50.0)


def measured(count: int):
    """A tracker at the truth whose neighbours are matched."""
    tracker, _ = planted_tracker(count)
    near = [(a, b) for a in range(count) for b in range(a + 1, min(a + 4, count))]
    tracker.map.graph.measure(near)
    return tracker


def matches_alone(tracker):
    """What the matches of a tracker say without what is wrong with all of them."""
    matches = room._Matches.among(tracker, tracker.segment.free)
    assert matches is not None
    return marginals.marginals(matches.grid, matches.problem, room.OPTIONS, room.CELLS)


def test_the_ends_of_a_walk_without_loops_are_known_least():
    tracker = measured(14)
    found = keyframe_uncertainty(tracker)
    assert found.timestamps == pytest.approx([k.timestamp for k in tracker.keyframes])
    for deviation in (found.position, found.rotation):
        assert min(deviation[0], deviation[13]) > 1.2 * deviation.min() > 0
    assert np.isfinite(found.depth).all()
    residual = matches_alone(tracker).normalised_residual
    assert 1.0 < float(residual.median()) < 1.4  # of a norm in two dimensions: 1.18


def test_a_bent_walk_strains_its_matches():
    tracker = measured(14)
    before = matches_alone(tracker).normalised_residual
    drift(tracker, scale=0.3, yaw=0.4)
    after = matches_alone(tracker).normalised_residual
    assert float(after.median()) > float(before.median()) + 0.5


def know_the_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lens_error, "PRIOR", (1e-9, 1e-9, 1e-9))
    monkeypatch.setattr(lens_error, "GIVEN_CENTRE", 1e-9)


def test_errors_that_all_matches_have_in_common_are_foretold(monkeypatch):
    """Errors of either half of the image in all keyframes, several times as large as usual."""
    flow_size, place_size = 0.5, 1.0
    know_the_lens(monkeypatch)
    monkeypatch.setattr(room, "USUAL_RESIDUAL", np.inf)
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
    know_the_lens(monkeypatch)
    lens_known = keyframe_uncertainty(tracker).depth
    monkeypatch.setattr(marginals, "COMMON_FLOW", 0.0)
    monkeypatch.setattr(marginals, "COMMON_PLACE", 0.0)
    strained = keyframe_uncertainty(tracker).depth
    assert (unsure > lens_known).all()
    assert (lens_known > strained).all()
    monkeypatch.setattr(room, "USUAL_RESIDUAL", np.inf)
    own = keyframe_uncertainty(tracker).depth
    assert own == pytest.approx(matches_alone(tracker).depth_deviation.numpy())


def test_the_focal_length_is_as_unsure_as_was_said_when_it_was_found():
    tracker = measured(14)
    known = keyframe_uncertainty(tracker).focal
    tracker.keyframes.table.lens = FoundLens(0.0, 0.0, 0.01, 0.01, 1.1, 0.2)
    assert keyframe_uncertainty(tracker).focal == 0.2 > known > 0


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


def test_strain_makes_matches_as_much_less_sure_and_the_lens_no_less(monkeypatch):
    tracker = measured(6)
    residual = matches_alone(tracker).normalised_residual.numpy() / USUAL_RESIDUAL
    know_the_lens(monkeypatch)
    strained = keyframe_uncertainty(tracker)
    monkeypatch.setattr(room, "USUAL_RESIDUAL", np.inf)
    calm = keyframe_uncertainty(tracker)
    factor = np.sqrt(np.mean(np.square(residual)))
    assert factor > 2
    assert strained.position == pytest.approx(factor * calm.position)
    assert strained.depth == pytest.approx(residual * calm.depth)
    monkeypatch.setattr(lens_error, "PRIOR", (3e2, 1e-9, 1e-9))
    lens_open = keyframe_uncertainty(tracker)
    monkeypatch.setattr(room, "USUAL_RESIDUAL", USUAL_RESIDUAL)
    both = keyframe_uncertainty(tracker)
    by_lens = np.square(lens_open.position) - np.square(calm.position)
    assert np.square(both.position) - np.square(strained.position) == pytest.approx(by_lens)


def test_without_matches_nothing_is_known():
    tracker, _ = planted_tracker(5)
    found = keyframe_uncertainty(tracker)
    assert (found.position == np.inf).all()
    assert (found.depth == np.inf).all()


def test_misfit_is_that_of_a_tenth_of_the_keyframes():
    rng = np.random.default_rng(0)
    even = rng.uniform(0.38, 0.46, 60)  # noisy all over
    assert misfit(even) < 1.12
    jerked = np.where(np.arange(60) < 8, 2 * even, even)
    assert 1.7 < misfit(jerked) < 2.2
    assert misfit(np.where(np.arange(60) < 3, 9 * even, even)) < 1.12  # a few are no tenth
    assert misfit(jerked / 4) < 1  # whatever fits as well as without flaws does
    assert misfit(np.append(even, np.inf)) == misfit(even)
    assert misfit(np.full(3, np.inf)) == 0


def test_frames_share_the_misfit_of_their_keyframes():
    tracker = measured(14)
    found = keyframe_uncertainty(tracker)
    residual = matches_alone(tracker).normalised_residual.numpy()
    assert found.misfit == pytest.approx(misfit(residual), rel=1e-4)
    assert found.misfit > 1
    assert found.at(np.array([0.0, 1.0])).misfit == found.misfit
