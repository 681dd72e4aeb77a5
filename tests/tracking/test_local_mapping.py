"""Frames from before a start: tracked backwards, with keyframes of their own."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from geogs.config import Config
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame
from geogs.world.frames import RelativeRotation
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import check_keyframes
from records import copied
from tracking_runs import CONFIG, metric_errors_cm
from tracking_scenes import CAMERA, ExactDepth, pose, render

BEFORE = 10
"""Frames without depth, and so without a map."""


PATH = [pose(0.03 * k, yaw=0.04 * k) for k in range(BEFORE + 2)]
PICTURES = [render(T) for T in PATH]


def started_late(links_err_by: float | None = None) -> Tracker:
    """Tracks the path; each frame before the start may be linked to the one after it by a rotation
    that errs by so many radians about the vertical."""
    config = Config(tracking=replace(CONFIG, init_keyframes=100))  # no start by matches
    tracker = lone_tracker(CAMERA, config)
    for k, (image, depth) in enumerate(PICTURES):
        if k == BEFORE and links_err_by is not None:
            for n, record in enumerate(tracker.map.recorder.log.records):
                turn = pose(0, yaw=links_err_by) @ np.linalg.inv(PATH[n]) @ PATH[n + 1]
                R = torch.from_numpy(turn[:3, :3])
                record.rotations = [RelativeRotation(n + 1, R, 1e-3)]
        tracker.track(Frame(k, k / 30, image, depth=ExactDepth(depth) if k >= BEFORE else None))
    return tracker


def largest_error_cm(tracker: Tracker) -> float:
    """The largest error of all frames, which have to be tracked, where the last one is right."""
    found = tracker.trajectory()
    assert found.states == ["tracked"] * len(PATH)
    return metric_errors_cm(found.T_wc[::-1], np.stack(PATH)[::-1]).max()


def test_errors_of_rotations_before_a_start_do_not_add_up():
    assert largest_error_cm(started_late(links_err_by=-0.06)) < 0.5


def test_what_was_seen_before_a_start_has_keyframes_again():
    tracker = started_late()
    keyframes = list(tracker.keyframes)
    assert [k.id for k in keyframes] == sorted(k.id for k in keyframes)
    assert all(a.frame_index < b.frame_index for a, b in pairwise(keyframes))
    early = [k for k in keyframes if k.frame_index < BEFORE]
    assert len(early) >= 2
    check_keyframes(copied(tracker.keyframes.table).attached(SampleGrid(CAMERA)), [])

    u, v = SampleGrid(CAMERA).pixels.long().unbind(-1)
    for keyframe in early:
        known = keyframe.has_known_depth
        exact = torch.from_numpy(1 / PICTURES[keyframe.frame_index][1])[v, u]
        assert float(known.float().mean()) > 0.5
        assert float((keyframe.inverse_depth / exact - 1).abs()[known].median()) < 0.03
    tracker.finish()
    assert largest_error_cm(tracker) < 0.5
