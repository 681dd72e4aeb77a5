"""A camera that is lost: found again by what it sees, or followed anew until a loop joins it."""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
import torch

from geogs.config import Config, LoopConfig, TrackingConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import sim3_exp
from geogs.loop.closer import LoopCloser
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.segment_trackers import Segments
from geogs.tracking.tracker import lone_tracker
from geogs.types import Frame
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.segments import SegmentTable, TrackState
from lit_rooms import lit_room
from loop_scenes import at_angle
from tracking_runs import error_cm

pytestmark = pytest.mark.system

CAMERA = Camera(fx=135.0, fy=135.0, cx=95.5, cy=71.5, width=192, height=144)
CONFIG = TrackingConfig(init_keyframes=5, patience=4)
LOOPS = LoopConfig(min_gap=100)  # only between segments


@cache
def image(angle: float) -> np.ndarray:
    return lit_room(0).render(CAMERA, at_angle(lit_room(0).scene, np.radians(angle))).image


def stream(angles: Sequence[float | None], cuts: Sequence[int] = ()) -> list[Frame]:
    """Frames looking outwards at angles in degrees; a covered lens where there is none."""
    black = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    return [
        Frame(k, k / 30, black if a is None else image(a), k in cuts) for k, a in enumerate(angles)
    ]


def run(frames: Sequence[Frame]) -> tuple[Segments, list]:
    """The whole stream through segments and loops."""
    grid = SampleGrid(CAMERA)
    operator = build_operator(CONFIG, grid)
    store = KeyframeTable.on(grid, operator.encode)
    segments = Segments(SegmentTable(), store, operator, Config(tracking=CONFIG))
    closer, results = LoopCloser(segments, LOOPS), []
    for frame in frames:
        results.append(segments.track(frame, closer.recognise))
        closer.update(results[-1])
    results.append(segments.finish())
    closer.update(results[-1], is_last=True)
    return segments, results


def error_of(segments: Segments, angles: Sequence[float | None]) -> float:
    """RMSE of the tracked camera centres after one similarity, centimetres."""
    trajectory = segments.trajectory()
    known = trajectory.tracked
    truth = np.stack([at_angle(lit_room(0).scene, np.radians(a or 0.0))[:3, 3] for a in angles])
    return error_cm(trajectory.T_wc[known, :3, 3], truth[known])


def test_a_covered_lens_is_survived_where_the_place_was_seen_before():
    angles = [*np.arange(0, 36, 2.0), *[None] * 8, *np.arange(10, 26, 2.0)]
    segments, results = run(stream(angles))
    states = [r.state for r in results[: len(angles)]]
    assert states[18:26] == [TrackState.LOST] * 8
    assert states[26:] == [TrackState.TRACKING] * 8
    assert [s.fate for s in segments.summary()] == ["world"]
    assert segments.trajectory().tracked.tolist() == [a is not None for a in angles]
    assert error_of(segments, angles) < 0.3


@pytest.mark.long
def test_a_jump_cut_begins_a_segment_that_a_loop_joins():
    there = np.arange(0, 48, 2.0)
    back = np.arange(150, 10, -2.5)
    angles = [*there, *back]
    segments, results = run(stream(angles))
    assert results[24].state is TrackState.LOST
    assert [r.finalized_elsewhere for r in results[24:60]] != [()] * 36
    fates = [s.fate for s in segments.summary()]
    assert fates == ["world", "joined"]
    untracked = np.flatnonzero(~segments.trajectory().tracked)
    assert len(untracked) <= 6
    assert set(untracked) <= set(range(24, 30))
    assert error_of(segments, angles) < 1.0
    ids = segments.keyframe_ids
    assert ids == sorted(set(ids))


@pytest.mark.long
def test_a_segment_that_meets_nothing_stays_apart():
    angles = [*np.arange(0, 60, 2.0), *np.arange(180, 210, 2.0)]
    segments, results = run(stream(angles, cuts=[30]))
    assert [s.fate for s in segments.summary()] == ["world", "apart"]
    trajectory = segments.trajectory()
    assert trajectory.tracked.tolist() == [True] * 30 + [False] * 15
    assert len(trajectory.timestamps) == 45
    # A declared cut is not waited for.
    assert results[30].state is TrackState.INITIALIZING
    world, apart = segments.summary()
    assert world.last_time < apart.first_time
    assert apart.keyframes >= 5


def test_the_largest_segment_becomes_the_world():
    angles = [*np.arange(0, 16, 2.0), *np.arange(120, 152, 2.0)]
    segments, results = run(stream(angles, cuts=[8]))
    assert results[-1].is_new_main
    assert results[-1].finalized == tuple(segments.keyframe_ids)
    assert [s.fate for s in segments.summary()] == ["apart", "world"]
    assert segments.trajectory().tracked.tolist() == [False] * 8 + [True] * 16


def test_moving_keyframes_keeps_what_they_see():
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    for frame in stream(np.arange(0, 16, 2.0)):
        tracker.track(frame)
    tracker.finish()
    for scale in (0.5, 1.0, 3.0):
        before = tracker.map.graph.reprojections([(0, 2), (3, 1)])
        centres = [torch.linalg.inv(s.T_cw)[:3, 3] for s in tracker.keyframes]
        xi = torch.tensor([0.3, -0.2, 0.5, 0.1, 0.4, -0.2, np.log(scale)], dtype=torch.float64)
        S = sim3_exp(xi)
        tracker.keyframes.correct(tracker.keyframes.moved(S))
        after = tracker.map.graph.reprojections([(0, 2), (3, 1)])
        assert float((after - before).abs().max()) < 2e-3
        for centre, state in zip(centres, tracker.keyframes, strict=True):
            expected = torch.linalg.inv(S) @ torch.cat([centre, torch.ones(1)])
            assert torch.allclose(torch.linalg.inv(state.T_cw)[:3, 3], expected[:3], atol=1e-9)
        assert tracker.trajectory().tracked.all()
