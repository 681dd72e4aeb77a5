"""The local adjustment reaches back to where the camera has moved."""

import torch

from geogs.tracking.local_mapping import window_length
from planted_walk import planted_tracker


def test_a_camera_that_moves_needs_no_more_than_the_least():
    tracker, _ = planted_tracker(12)
    assert window_length(list(tracker.keyframes), 4, 10, 0.0) == 4
    assert window_length(list(tracker.keyframes), 4, 10, 1e-6) == 4
    assert window_length(list(tracker.keyframes)[:3], 4, 10, 10.0) == 3
    assert window_length(list(tracker.keyframes), 4, 10, 1e3) == 10


def test_it_ends_where_the_baseline_is_reached():
    tracker, _ = planted_tracker(12)
    keyframes = list(tracker.keyframes)
    depth = 1 / float(keyframes[-1].inverse_depth.median())
    for n, keyframe in enumerate(keyframes):
        T_cw = torch.eye(4, dtype=torch.float64)
        T_cw[0, 3] = 0.01 * depth * n
        keyframe.T_cw = T_cw
    assert window_length(keyframes, 4, 10, 0.055) == 7
    assert window_length(keyframes, 4, 6, 0.055) == 6
