"""A depth sensor in the tracker: metres from the first frame on, whatever the motion."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from geogs.config import Config
from geogs.geometry.lie import se3_inverse
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame
from geogs.world.cell_depths import MeasuredCells
from geogs.world.grid import SampleGrid
from geogs.world.segments import TrackState
from records import copied
from tracking_runs import CONFIG, metric_errors_cm
from tracking_scenes import CAMERA, pose, render, sideways


@dataclass(frozen=True, eq=False)
class Picture:
    """Depth with the noise of a sensor; nothing in its left eighth."""

    depth: np.ndarray
    seed: int

    def metres(self) -> np.ndarray:
        noise = np.random.default_rng(self.seed).standard_normal(self.depth.shape)
        noisy = 1 / (1 / self.depth + 0.0015 * noise)
        noisy[:, : noisy.shape[1] // 8] = 0
        return noisy.astype(np.float32)


def sensed(path: list[np.ndarray], every: int = 1) -> list[Frame]:
    """Rendered frames, every so many with depth."""
    found = []
    for k, T in enumerate(path):
        image, depth = render(T)
        with_depth = Picture(depth, k) if k % every == 0 else None
        found.append(Frame(k, k / 30, image, depth=with_depth))
    return found


def tracked(frames: list[Frame]) -> Tracker:
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    for frame in frames:
        tracker.track(frame)
    tracker.finish()
    return tracker


def test_the_first_frame_starts_a_map_in_metres():
    path = sideways(2)
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    assert tracker.track(sensed(path)[0]).state is TrackState.TRACKING
    assert tracker.segment.is_metric
    (keyframe,) = tracker.keyframes
    truth = render(path[0])[1]
    grid = SampleGrid(CAMERA)
    u, v = grid.pixels.long().unbind(-1)
    exact = torch.from_numpy(1 / truth)[v, u]
    known = keyframe.information > 0
    assert 0.5 < float(known.float().mean()) < 0.95
    off = ((keyframe.inverse_depth - exact).abs() * keyframe.information.sqrt())[known]
    assert float(off.median()) < 0.5  # the noise of single pixels averages
    assert bool((keyframe.inverse_depth > 0).all())
    assert copied(tracker.segment).is_metric
    again = copied(tracker.keyframes.table)[0]
    assert torch.equal(again.measured.information, keyframe.measured.information)


def test_frames_without_depth_wait_for_one_that_has_it():
    frames = [replace(f, depth=None) if f.index < 3 else f for f in sensed(sideways(5))]
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    states = [tracker.track(f).state for f in frames]
    assert states[:3] == [TrackState.INITIALIZING] * 3
    assert states[3:] == [TrackState.TRACKING] * 2
    starts = [k.frame_index for k in tracker.keyframes if k.measured is not None]
    assert starts[0] == 3
    assert next(iter(tracker.keyframes)).frame_index == 0  # tracked back from there
    assert len(tracker.trajectory().timestamps) == 5


def test_too_little_depth_starts_nothing():
    frame = sensed(sideways(1))[0]
    nothing = Picture(np.full_like(frame.depth.depth, 50.0), 0)
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    assert tracker.track(replace(frame, depth=nothing)).state is TrackState.INITIALIZING
    assert not tracker.segment.is_metric
    assert all(k.measured is None for k in tracker.keyframes)


@pytest.mark.system
def test_places_are_in_metres_with_few_depths():
    path = sideways(24)
    tracker = tracked(sensed(path, every=6))
    errors = metric_errors_cm(tracker.trajectory().T_wc, np.stack(path))
    assert errors.max() < 0.5  # of a path of 58 cm
    assert sum(k.measured is not None for k in tracker.keyframes) >= 3


@pytest.mark.system
def test_a_camera_that_only_turns_has_a_place():
    path = [pose(0.0, yaw=0.5 * np.sin(0.1 * k)) for k in range(24)]
    tracker = tracked(sensed(path))
    assert tracker.trajectory().tracked.all()
    assert metric_errors_cm(tracker.trajectory().T_wc, np.stack(path)).max() < 0.5


def test_measurements_follow_the_scale_of_their_keyframe():
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    tracker.track(sensed(sideways(1))[0])
    (keyframe,) = tracker.keyframes
    before = keyframe.measured
    copy = MeasuredCells(before.inverse_depth, before.information)
    tracker.keyframes.rescale(2.0)
    assert torch.equal(keyframe.measured.inverse_depth, copy.inverse_depth / 2)
    assert torch.equal(keyframe.measured.information, copy.information * 4)
    torch.testing.assert_close(se3_inverse(keyframe.T_cw), torch.eye(4, dtype=torch.float64))
