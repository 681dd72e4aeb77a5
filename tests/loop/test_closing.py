"""A closing that was computed beside tracking comes to what it would have been at once."""

from dataclasses import replace

import torch

from drifted_walk import NOTHING, closer_of, true_pose, world
from geogs.config import LoopConfig
from geogs.geometry.lie import se3_exp
from geogs.loop.closure import brought_forward
from geogs.types import PoseCorrection
from keyframe_samples import Sample, add

OPTIONS = LoopConfig(residual=0.0, min_change=0.0, close_every=1)
FINAL = replace(NOTHING, finalized=(7,))
"""Of a frame at which a keyframe became final."""
STEP = se3_exp(torch.tensor([0.02, -0.01, 0.03, 0.01, 0.02, -0.015], dtype=torch.float64))
"""Of a camera that moves, or is adjusted."""


def moved(n: int) -> torch.Tensor:
    return se3_exp(0.1 * n * torch.tensor([1.0, 0.3, -0.2, 0.1, -0.2, 0.05]).double())


def correction() -> PoseCorrection:
    """Of keyframes 2, 4 and 7."""
    ids = (2, 4, 7)
    after = {k: moved(k + 1) @ STEP for k in ids}
    return PoseCorrection({k: moved(k) for k in ids}, after, {2: 1.0, 4: 1.1, 7: 0.8})


def world_similarity(T: torch.Tensor, after: torch.Tensor, scale: float) -> torch.Tensor:
    """How what a keyframe shows moves in the world, written out: points of the camera are divided
    by the scale and seen from where the camera is afterwards."""
    shrink = torch.diag(torch.tensor([1 / scale] * 3 + [1.0], dtype=torch.float64))
    return torch.linalg.inv(after) @ shrink @ T


def test_keyframes_that_have_not_changed_are_corrected_as_was_found():
    found = correction()
    now = brought_forward(found, dict(found.before))
    assert now.scale == found.scale
    for k, T in found.after.items():
        assert torch.equal(now.after[k], T)


def test_who_was_adjusted_and_who_came_later_move_with_the_world_around_them():
    found = correction()
    T_cw = {2: found.before[2], 7: STEP @ found.before[7], 9: moved(9), 5: moved(5)}  # 4 is gone
    now = brought_forward(found, T_cw)
    assert set(now.after) == {2, 5, 7, 9}
    for id, of in ((2, 2), (5, 4), (7, 7), (9, 7)):
        expected = world_similarity(found.before[of], found.after[of], found.scale[of])
        here = world_similarity(T_cw[id], now.after[id], now.scale[id])
        torch.testing.assert_close(here, expected, rtol=0, atol=1e-12)
        R = now.after[id][:3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3).double(), rtol=0, atol=1e-12)
        assert torch.equal(now.before[id], T_cw[id])


def corrected(waits: bool, meanwhile: bool = False):
    """The walk after its loop was closed, at once or by a thread; ``meanwhile`` a keyframe is
    adjusted and another is added."""
    tracker, loop = world(drift=0.06)
    closer = closer_of(tracker, loop, OPTIONS, waits)
    segment = tracker.keyframes
    closer.update(FINAL)
    assert closer.table.closures == waits
    if meanwhile:
        segment[5].T_cw = STEP @ segment[5].T_cw
        image = torch.zeros(48, 64, 3, dtype=torch.uint8).numpy()
        add(segment, Sample(8, image, STEP @ segment[7].T_cw, torch.full((6, 8), 0.5)))
    if not waits:
        closer._asked.answer.result(timeout=30)
        closer.update(NOTHING)  # which brings no keyframe: nothing happens
        assert closer.table.closures == 0
        closer.update(FINAL)
    assert closer.table.closures == 1
    return segment, closer


def test_a_closing_by_a_thread_comes_to_the_same_as_at_once():
    (at_once, _), (later, closer) = corrected(True), corrected(False)
    drift = [float((k.T_cw - true_pose(k.id)).norm()) for k in world(drift=0.06)[0].keyframes]
    for one, other in zip(at_once, later, strict=True):
        assert torch.equal(one.T_cw, other.T_cw)
        assert torch.equal(one.inverse_depth, other.inverse_depth)
        assert one.scale == other.scale
    left = float((later[7].T_cw - true_pose(7)).norm())
    assert left < 0.5 * drift[7]
    assert len(closer.segments.main.keyframes.take_corrections()) == 1


def test_keyframes_of_the_meantime_move_with_their_neighbours():
    (at_once, _), (later, _) = corrected(True), corrected(False, meanwhile=True)
    for k in (0, 1, 2, 3, 4, 6, 7):
        assert torch.equal(at_once[k].T_cw, later[k].T_cw)
    scale = at_once[5].scale  # of lengths around it, by which the step that was made has changed
    step = STEP.clone()
    step[:3, 3] *= scale
    torch.testing.assert_close(later[5].T_cw, step @ at_once[5].T_cw, rtol=0, atol=1e-12)
    step = STEP.clone()
    step[:3, 3] *= at_once[7].scale
    expected = step @ at_once[7].T_cw
    torch.testing.assert_close(later[8].T_cw, expected, rtol=0, atol=1e-12)
    assert later[8].scale == at_once[7].scale
    torch.testing.assert_close(later[8].inverse_depth, torch.full((48,), 0.5) / later[8].scale)


def test_a_closing_of_a_world_that_is_no_more_is_asked_for_again():
    tracker, loop = world(drift=0.06)
    closer = closer_of(tracker, loop, OPTIONS, waits=False)
    closer.update(FINAL)
    before = tracker.keyframes.poses(tracker.keyframes.ids)
    closer._asked.answer.result(timeout=30)
    closer._age += 1  # as joining a segment does
    closer.update(FINAL)
    assert closer.table.closures == 0
    assert torch.equal(tracker.keyframes.poses(tracker.keyframes.ids), before)
    closer.update(NOTHING, is_last=True)
    assert closer.table.closures == 1
