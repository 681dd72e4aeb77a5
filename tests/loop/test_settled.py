"""No look is spent where it could change nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from drifted_walk import closer_of, world
from geogs.config import LoopConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.loop import settled
from geogs.loop.settled import settled_pairs
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import RelativePoses
from keyframe_samples import Sample, segment_of

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
COUNT, GAP, CHANGE = 30, 10, 0.002


@pytest.fixture
def segment() -> KeyframeSet:
    """A straight way past things two units away."""
    image, samples = np.zeros((48, 64, 3), np.uint8), []
    for n in range(COUNT):
        T = torch.eye(4, dtype=torch.float64)
        T[0, 3] = -0.1 * n
        samples.append(Sample(n, image, T, torch.full((6, 8), 0.5)))
    return segment_of(samples, CAMERA)


def relative(
    segment: KeyframeSet, first: int, second: int, turn: float = 0.0, is_loop: bool = True
) -> RelativePoses:
    """Both directions between two keyframes as they stand, turned by some radians."""
    xi = torch.tensor([0, 0, 0, 0, turn, 0], dtype=torch.float64)
    there = se3_exp(xi) @ segment[second].T_cw @ se3_inverse(segment[first].T_cw)
    pair = torch.tensor([first, second])
    G = torch.stack([there, se3_inverse(there)])
    known = torch.ones(2, 7, dtype=torch.float64)
    return RelativePoses(pair, pair.flip(0), G, known, torch.tensor([is_loop] * 2))


@pytest.mark.parametrize(
    ("turn", "is_loop", "is_settled"),
    [(0.0, True, True), (0.0015, True, True), (0.0021, True, False), (0.1, False, True)],
)
def test_a_loop_is_settled_while_poses_agree_and_edges_always(segment, turn, is_loop, is_settled):
    known = relative(segment, 3, 25, turn, is_loop)
    found = settled_pairs(segment, known, {}, GAP, CHANGE)
    assert found == ([(3, 25)] if is_settled else [])


def test_a_change_of_scale_or_of_place_counts_too(segment):
    for change in ((0, 3, 0.004), (1, 1, None)):
        known = relative(segment, 3, 25)
        row, column, by = change
        G = known.G.clone()
        if by is None:
            G[:, :3] *= 1.003
        else:
            G[:, row, column] += 1.1 * by  # 2.2 parts in 1000 of the depth
        moved = replace(known, G=G)
        assert settled_pairs(segment, moved, {}, GAP, CHANGE) == []
        assert settled_pairs(segment, moved, {}, GAP, 0.004) == [(3, 25)]


def test_edges_between_neighbours_settle_no_revisit(segment):
    edges = [(4, 13), (13, 4), (4, 14), (14, 4), (20, 29)]
    none = RelativePoses.none()
    assert settled_pairs(segment, none, edges, GAP, CHANGE) == [(4, 14)]
    near = relative(segment, 20, 28, is_loop=False)
    assert settled_pairs(segment, near, (), GAP, CHANGE) == []


def test_only_recent_keyframes_matter(segment, monkeypatch):
    monkeypatch.setattr(settled, "RECENT", 10)
    known = relative(segment, 3, 18)
    assert settled_pairs(segment, known, [(2, 17), (5, 21)], GAP, CHANGE) == [(5, 21)]


def test_a_loop_that_moves_nothing_asks_for_no_closing():
    tracker, loop = world(drift=0.06)
    sure = LoopConfig(residual=0.0)
    number = tracker.segment.number
    assert closer_of(tracker, loop, sure).table.constraints[number].pending == 1
    far = replace(sure, min_change=10.0)
    tracker, loop = world(drift=0.06)
    assert closer_of(tracker, loop, far).table.constraints[number].pending == 0
