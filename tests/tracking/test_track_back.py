"""Frames from before a start: tracked backwards, with keyframes of their own."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch

from geogs.config import Config
from geogs.tracking.tracker import lone_tracker
from geogs.types import Frame
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import check_keyframes
from records import copied
from tracking_runs import CONFIG
from tracking_scenes import CAMERA, pose, render

BEFORE = 10
"""Frames without depth, and so without a map."""


@dataclass(frozen=True, eq=False)
class Exact:
    """Depth without error."""

    depth: np.ndarray

    def metres(self) -> np.ndarray:
        return self.depth.astype(np.float32)


def test_what_was_seen_before_a_start_has_keyframes_again():
    path = [pose(0.03 * k, yaw=0.04 * k) for k in range(BEFORE + 2)]
    pictures = [render(T) for T in path]
    frames = [
        Frame(k, k / 30, image, depth=Exact(depth) if k >= BEFORE else None)
        for k, (image, depth) in enumerate(pictures)
    ]
    config = Config(tracking=replace(CONFIG, init_keyframes=100))  # no start by matches
    tracker = lone_tracker(CAMERA, config)
    for frame in frames:
        tracker.track(frame)
    keyframes = list(tracker.keyframes)
    assert [k.id for k in keyframes] == sorted(k.id for k in keyframes)
    assert all(a.frame_index < b.frame_index for a, b in pairwise(keyframes))
    early = [k for k in keyframes if k.frame_index < BEFORE]
    assert len(early) >= 2
    check_keyframes(copied(tracker.keyframes.table).attached(SampleGrid(CAMERA)), [])

    u, v = SampleGrid(CAMERA).pixels.long().unbind(-1)
    for keyframe in early:
        known = keyframe.has_known_depth
        exact = torch.from_numpy(1 / pictures[keyframe.frame_index][1])[v, u]
        assert float(known.float().mean()) > 0.5
        assert float((keyframe.inverse_depth / exact - 1).abs()[known].median()) < 0.03
    tracker.finish()
    found, truth = tracker.trajectory(), np.stack(path)
    assert found.states == ["tracked"] * len(path)
    there = truth[-1] @ np.linalg.inv(found.T_wc[-1]) @ found.T_wc
    assert 100 * np.linalg.norm((there - truth)[:, :3, 3], axis=1).max() < 0.5
