"""Poses of the frames between keyframes."""

from dataclasses import replace

import numpy as np
import torch

from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.frame_lenses import shift_frames
from geogs.tracking.frames.frame_recorder import FrameRecorder, pose_of
from geogs.tracking.frames.interpolation import interpolate
from geogs.tracking.frames.pose_filling import depth_aware_weight, row_errors, solve_trajectory
from geogs.types import FlowMatch, Frame, FrameLens, SeenRows
from geogs.world.frames import FrameLog
from planted_walk import planted_tracker
from records import copied


def test_gaps_are_bridged_by_constant_motion_and_ends_are_held():
    xi = torch.tensor([0.3, -0.1, 0.2, 0.1, 0.2, -0.1], dtype=torch.float64)
    truth = [se3_exp(k * xi) for k in range(5)]
    known = [None, truth[1], None, truth[3], None]
    out = interpolate(np.arange(5.0), known)
    expected = [truth[1], truth[1], truth[2], truth[3], truth[3]]
    np.testing.assert_allclose(out, np.stack([se3_inverse(T).numpy() for T in expected]), atol=1e-9)


def test_nothing_known_is_the_identity():
    assert np.array_equal(interpolate(np.arange(2.0), [None, None]), np.tile(np.eye(4), (2, 1, 1)))


def test_uncertain_depth_lowers_the_weight_along_its_direction_only():
    weight = torch.full((1, 1, 2), 25.0)
    slope = torch.tensor([[[10.0, 0.0]]])
    information = torch.tensor([[100.0]])
    out = depth_aware_weight(weight, slope, information)
    torch.testing.assert_close(out, torch.tensor([[[1 / (0.04 + 1.0), 25.0]]]))
    assert float(depth_aware_weight(weight, slope, 0 * information).max()) == 0


def frame(index: int) -> Frame:
    """One that nobody looks at."""
    return Frame(index, index / 30, np.zeros((2, 2, 3), np.uint8))


def test_frames_of_a_culled_keyframe_keep_their_place_and_others_are_not_touched():
    tracker, _ = planted_tracker(6)
    log = FrameLog()
    recorder = FrameRecorder(log, tracker.keyframes, tracker.map.operator)
    step = se3_exp(torch.tensor([0.02, 0, 0, 0, 0.01, 0], dtype=torch.float64))
    for n in range(5):
        tracker.keyframes[n].frame_index = 3 * n
        recorder.add_keyframe(tracker.keyframes[n])
        for k in (1, 2):
            recorder.add(frame(3 * n + k), n, n, step)
    before = [pose_of(r, tracker.keyframes).clone() for r in log.records]
    recorder.keyframe_removed(tracker.keyframes.remove(3), 2)
    assert [r.anchor for r in log.records] == [0] * 3 + [1] * 3 + [2] * 6 + [4] * 3
    for record, T_cw in zip(log.records, before, strict=True):
        torch.testing.assert_close(pose_of(record, tracker.keyframes), T_cw)
    assert 9 in [r.index for r in log.records if r.image is not None]


def test_what_is_kept_of_a_frame_is_small_and_finds_its_pose():
    tracker, T = planted_tracker(4, sigma=0.0)
    log = FrameLog()
    recorder = FrameRecorder(log, tracker.keyframes, tracker.map.operator)
    match, _ = tracker.map.operator.measure([0], [2])
    wrong = se3_exp(torch.tensor([0.02, 0, 0.01, 0, 0.01, 0], dtype=torch.float64))
    recorder.add(frame(50), 2, 0, wrong @ T[2], FlowMatch(match.pixels, match.weight))
    kept = log.records[0].observations[0]
    cells = len(kept.position)
    assert kept.position.nbytes + kept.half_weight.nbytes == 8 * cells
    assert cells <= (tracker.keyframes.grid.size + 9) // 3
    found = torch.from_numpy(solve_trajectory(log, tracker.keyframes).T_wc[0])
    # Positions are known to 1/800 pixel here, of 75 pixels focal length at 3 metres.
    torch.testing.assert_close(se3_inverse(found), T[2], rtol=0, atol=2e-4)


def test_a_lens_bends_what_is_found_of_a_frame_where_that_is_not_where_tracking_left_it():
    tracker, T = planted_tracker(4, sigma=0.0)
    match, _ = tracker.map.operator.measure([0], [2])
    wrong = se3_exp(torch.tensor([0.2, -0.1, 0.1, 0, 0.05, 0.1], dtype=torch.float64))
    shifts = []
    for left in (T[2], wrong @ T[2]):
        log = FrameLog()
        recorder = FrameRecorder(log, tracker.keyframes, tracker.map.operator)
        recorder.add(frame(50), 2, 0, left, FlowMatch(match.pixels, match.weight))
        recorder.add(frame(51), 2, 0, left, FlowMatch(match.pixels, match.weight))
        log.records[1].anchor = 99  # of another segment by now: nothing says where it is here
        shift_frames(log, tracker.keyframes, {50: FrameLens(0.0, 0.05, -0.02)})
        assert log.records[1].observations[0].lens_shift is None
        shifts.append(log.records[0].observations[0].lens_shift.int())
    assert int(shifts[0].abs().max()) > 40
    assert int((shifts[1] - shifts[0]).abs().max()) <= 1


def test_rows_go_where_the_frames_go():
    tracker, _ = planted_tracker(3)
    rows = SeenRows(torch.zeros(3, 4, 2).half(), torch.zeros(3, 4).half())
    logs = [FrameLog() for _ in range(3)]
    recorders = [FrameRecorder(log, tracker.keyframes, tracker.map.operator) for log in logs]
    for n, recorder in enumerate(recorders):
        recorder.note_rows(replace(frame(n), rows=rows))
        recorder.note_rows(frame(10 + n))  # of a global shutter
    recorders[0].absorb(recorders[1])
    recorders[0].give_up(recorders[2])
    assert set(copied(logs[0]).rows) == {0, 1, 2}
    assert row_errors(logs[1], tracker.keyframes) is not None
    assert row_errors(FrameLog(), tracker.keyframes) is None
    recorders[2].note_rows(replace(frame(20), rows=replace(rows, is_rectified=False)))
    assert set(logs[2].rows) == {2}
    assert not copied(logs[2]).open_rows.is_rectified
