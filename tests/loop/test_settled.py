"""No look is spent where it could change nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from drifted_walk import closer_of, world
from geogs.config import LoopConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.loop import detect, settled
from geogs.loop.detect import LoopDetector
from geogs.loop.settled import settled_pairs
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import RelativePoses
from keyframe_samples import Sample, segment_of
from lit_rooms import lit_room
from loop_scenes import keyframes, orbit, room_views

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
COUNT, GAP, CHANGE = 30, 10, 0.002
LAP, AGAIN = 18, 3


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


@pytest.fixture(scope="module")
def laps():
    """A lap of a room and the beginning of two more, 4 and 8 degrees aside."""
    scene = lit_room(3).scene
    poses = orbit(scene, LAP)
    for lap in (1, 2):
        poses += orbit(scene, LAP, np.radians(4 * lap))[:AGAIN]
    return room_views(3, poses), poses


def test_near_what_is_settled_nothing_is_looked_at(laps, monkeypatch):
    store, operator = keyframes(*laps)
    checked = []
    check = detect.dense_check
    monkeypatch.setattr(
        detect, "dense_check", lambda *of: checked.append((of[2].id, of[3].id)) or check(*of)
    )
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=GAP))
    assert detector.update(store.ids[: LAP + 1], is_last=True, settled=[(0, LAP)]) == ()
    assert checked == []
    assert detector.update(store.ids[LAP + 1 : LAP + 2], is_last=True)
    assert checked


def test_what_two_loops_say_together_is_not_asked_again(laps, monkeypatch):
    for module in ("search", "detect"):
        monkeypatch.setattr(f"geogs.loop.{module}.SUPPRESSION", 1)
    store, operator = keyframes(*laps)
    detector = LoopDetector(store.table, operator, LoopConfig(min_gap=GAP))
    first = detector.update(store.ids[: LAP + AGAIN], is_last=True)
    assert {(loop.first % LAP, loop.second % LAP) for loop in first} & {(0, 0), (0, 1), (1, 1)}
    implied = detector._is_implied(0, [replace(first[0], first=first[0].second)], ())
    assert implied == (first[0].first <= 1)


def test_a_loop_that_moves_nothing_asks_for_no_closing():
    tracker, loop = world(drift=0.06)
    sure = LoopConfig(residual=0.0)
    number = tracker.segment.number
    assert closer_of(tracker, loop, sure).table.constraints[number].pending == 1
    far = replace(sure, min_change=10.0)
    tracker, loop = world(drift=0.06)
    assert closer_of(tracker, loop, far).table.constraints[number].pending == 0
