"""Velocity of the camera while it reads a frame: equations, and what is known of it before."""

import numpy as np
import pytest
import torch

from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking import row_twists
from geogs.tracking.frames.row_errors import RowErrors, slope_at_zero
from geogs.tracking.locate.pose_deviation import PoseDeviation
from geogs.tracking.row_twists import EVIDENCE, solved_twists
from geogs.tracking.tracker import lone_tracker
from geogs.types import SeenRows, Trajectory
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA

RATE, COUNT, FRAME = 30.0, 9, 4
XI = torch.tensor([0.4, -0.2, 0.1, 0.3, -1.2, 0.2], dtype=torch.float64)
KNOCK = torch.tensor([3.0, 1.0, -2.0, 10.0, -25.0, 5.0], dtype=torch.float64)


def errors(knock: torch.Tensor) -> RowErrors:
    """Of a camera that moves evenly, and is accelerated from one frame on."""
    times = (np.arange(COUNT) - FRAME) / RATE
    T_cw = [se3_exp(XI * t + knock * max(t, 0.0) ** 2 / 2) for t in times]
    path = Trajectory(times, np.stack([se3_inverse(T).numpy() for T in T_cw]), np.ones(COUNT, bool))
    v = torch.arange(-1, CAMERA.height // 8 + 1) * 8 + 3.5
    seconds = 0.02 * (v / (CAMERA.height - 1) - 0.5)[:, None].repeat(1, CAMERA.width // 8 + 2)
    rows = SeenRows(torch.zeros(*seconds.shape, 2).half(), seconds.half(), 0.0)
    return RowErrors(SampleGrid(CAMERA), dict.fromkeys(range(COUNT), rows), range(COUNT), path)


@pytest.mark.parametrize("times", [(-2, -1, 0, 1, 2), (-1, 0, 1), (0, 1, 2, 3, 4), (-0.4, 0, 1.1)])
def test_the_slope_is_that_of_the_polynomial_through_all(times):
    t = torch.tensor(times, dtype=torch.float64) / RATE
    values = torch.from_numpy(np.random.default_rng(3).normal(size=(2, len(times), 6)))
    found = slope_at_zero(torch.stack([t, 2 * t]), values)
    for own, value, slope in zip((t, 2 * t), values, found, strict=True):
        reference = np.polyfit(own.numpy(), value.numpy(), len(times) - 1)[-2]
        np.testing.assert_allclose(slope, reference, rtol=1e-8)


def test_the_twist_is_the_most_likely_one_and_leaves_open_what_the_pose_follows_it_by():
    rng = np.random.default_rng(5)
    J, r = (torch.from_numpy(rng.normal(size=(3, 40, n))) for n in (12, 1))
    doubts = torch.from_numpy(rng.uniform(0.1, 2.0, (3, 6)))
    A = J.mT @ torch.cat([J, r], 2)
    twists, open_ = solved_twists(A, doubts)
    for n, (own, right, doubt) in enumerate(zip(J, r, doubts, strict=True)):
        prior = torch.eye(12, dtype=torch.float64)[6:] / doubt[:, None]
        weighed = torch.cat([EVIDENCE**0.5 * own, prior])
        right = torch.cat([EVIDENCE**0.5 * right, torch.zeros(6, 1, dtype=torch.float64)])
        torch.testing.assert_close(twists[n], torch.linalg.lstsq(weighed, right).solution[6:, 0])
        both = torch.linalg.inv(weighed.mT @ weighed)[:6, :6]
        alone = torch.linalg.inv(own[:, :6].mT @ own[:, :6])
        squares = (both - alone / EVIDENCE).diagonal().reshape(2, 3).sum(1)
        np.testing.assert_allclose([open_[n].position, open_[n].rotation], squares.sqrt())
    nothing, no_doubt = torch.zeros_like(A), torch.zeros_like(doubts)
    twists, open_ = solved_twists(A, no_doubt)
    assert not twists.any()
    assert open_[0] == PoseDeviation(0.0, 0.0)
    assert not solved_twists(nothing, doubts)[0].any()


def test_an_even_motion_leaves_no_doubt_and_a_knock_as_much_as_it_is_missed_by():
    assert float(errors(0 * KNOCK).twist_deviations([FRAME]).max()) < 1e-4
    knocked = errors(KNOCK)
    # A quartic through the poses takes the rate for this much higher where it begins to change.
    missed = KNOCK / RATE / 6
    told, none = knocked.twist_deviations([FRAME, COUNT])
    for part in (slice(0, 3), slice(3, 6)):
        assert 0.3 < float(told[part][0] / missed[part].norm()) < 1.0
    assert not none.any()


def test_twists_move_what_rows_show_in_proportion_to_their_times():
    grid = SampleGrid(CAMERA)
    before, more = errors(0 * KNOCK), torch.tensor([0.0, 0, 0, 0, 0.1, 0], dtype=torch.float64)
    after, depth = (
        before.with_twists([COUNT, FRAME], torch.stack([2 * more, more])),
        torch.zeros(1, grid.size),
    )
    pixels, frames = grid.pixels[None], [FRAME]
    moved = (
        after.of_pixels(frames, pixels, depth).shift - before.of_pixels(frames, pixels, depth).shift
    )
    x = (pixels[..., 0] - CAMERA.cx) / CAMERA.fx
    expected = -CAMERA.fx * (1 + x.square()) * 0.1 * after.seconds(frames, pixels)
    torch.testing.assert_close(moved[..., 0], expected, atol=5e-3, rtol=0.05)
    assert not after.seconds([COUNT], pixels).any()


@pytest.mark.parametrize("part", [0.0, 0.7, 1.0])
def test_the_part_seen_is_that_of_least_squares_with_a_pose_of_each_frame(monkeypatch, part):
    rng, other = np.random.default_rng(7), KNOCK / 10
    J = torch.from_numpy(rng.normal(size=(COUNT, 40, 12)))
    pose = torch.from_numpy(rng.normal(size=(COUNT, 6)))
    before = errors(0 * KNOCK)
    after = before.with_twists(range(COUNT), other.expand(COUNT, 6))
    frames = list(range(COUNT))
    way = after.twists(frames) - before.twists(frames)
    torch.testing.assert_close(way[FRAME], other, atol=1e-3, rtol=1e-3)
    noise = torch.from_numpy(rng.normal(size=(COUNT, 40, 1)))
    r = J @ torch.cat([pose, part * way], 1)[..., None] + noise
    A = J.mT @ torch.cat([J, r], 2)
    monkeypatch.setattr(row_twists, "_summed", lambda *_: (frames, A))
    columns = [torch.block_diag(*J[..., :6]), (J[..., 6:] @ way[..., None]).reshape(-1, 1)]
    reference = torch.linalg.lstsq(torch.cat(columns, 1), r.reshape(-1, 1)).solution[-1, 0]
    tracker = lone_tracker(CAMERA)
    found = row_twists.part_seen(before, after, tracker.keyframes, {}, tracker.segment.frames)
    assert found == pytest.approx(float(reference), rel=1e-6)
    assert found == pytest.approx(part, abs=0.1)
