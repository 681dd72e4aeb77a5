"""Poses of the frames between keyframes."""

from dataclasses import replace

import numpy as np
import torch

from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.gaps import interpolate
from geogs.tracking.trajectory import TrajectoryRecorder, depth_aware_weight
from geogs.types import FlowMatch, Frame, SeenRows
from planted_walk import planted_tracker


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
    recorder = TrajectoryRecorder(tracker.keyframes, tracker.operator)
    step = se3_exp(torch.tensor([0.02, 0, 0, 0, 0.01, 0], dtype=torch.float64))
    for n in range(5):
        tracker.keyframes[n].frame_index = 3 * n
        recorder.add_keyframe(n)
        for k in (1, 2):
            recorder.add(frame(3 * n + k), n, n, step)
    before = [recorder._pose(r).clone() for r in recorder.records]
    recorder.keyframe_removed(tracker.keyframes.remove(3), 2)
    assert [r.anchor for r in recorder.records] == [0] * 3 + [1] * 3 + [2] * 6 + [4] * 3
    for record, T_cw in zip(recorder.records, before, strict=True):
        torch.testing.assert_close(recorder._pose(record), T_cw)
    assert 9 in [p.record.index for p in recorder._pending]


def test_what_is_kept_of_a_frame_is_small_and_finds_its_pose():
    tracker, T = planted_tracker(4, sigma=0.0)
    recorder = TrajectoryRecorder(tracker.keyframes, tracker.operator)
    match, _ = tracker.operator.measure([0], [2])
    wrong = se3_exp(torch.tensor([0.02, 0, 0.01, 0, 0.01, 0], dtype=torch.float64))
    recorder.add(frame(50), 2, 0, wrong @ T[2], FlowMatch(match.pixels, match.weight))
    kept = recorder.records[0].observations[0]
    cells = len(kept.position)
    assert kept.position.nbytes + kept.half_weight.nbytes == 8 * cells
    assert cells <= (tracker.grid.size + 9) // 3
    found = torch.from_numpy(recorder.solve().T_wc[0])
    # Positions are known to 1/800 pixel here, of 75 pixels focal length at 3 metres.
    torch.testing.assert_close(se3_inverse(found), T[2], rtol=0, atol=2e-4)


def test_rows_go_where_the_frames_go():
    tracker, _ = planted_tracker(3)
    rows = SeenRows(torch.zeros(3, 4, 2).half(), torch.zeros(3, 4).half())
    recorders = [TrajectoryRecorder(tracker.keyframes, tracker.operator) for _ in range(4)]
    for n, recorder in enumerate(recorders[:3]):
        recorder.see(replace(frame(n), rows=rows))
        recorder.see(frame(10 + n))  # of a global shutter
    recorders[0].absorb(recorders[1])
    recorders[0].give_up(recorders[2])
    recorders[3].load(recorders[0].state())
    assert set(recorders[3].rows) == {0, 1, 2}
    assert recorders[1].row_errors() is not None
    assert TrajectoryRecorder(tracker.keyframes, tracker.operator).row_errors() is None
