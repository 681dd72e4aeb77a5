"""Cameras that only turn: before there is a map, where it is out of sight, and for ever."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from geogs.config import Config, TrackingConfig
from geogs.errors import TrackingLost
from geogs.evaluation.rotation_errors import rotation_angle
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.segment_trackers import Segments
from geogs.tracking.start import start_up
from geogs.tracking.start.initialise import FORGIVING, LAST_DEVIATION, Attempt, initialise
from geogs.types import Frame, Trajectory
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.segments import SegmentTable, TrackState, check_segments
from records import copied
from tracking_runs import CONFIG, error_cm
from tracking_scenes import CAMERA, frames, pose, sideways

pytestmark = pytest.mark.system


def resumed(keyframes: KeyframeTable, table: SegmentTable) -> Segments:
    """Segments on tables that were just read."""
    grid = SampleGrid(CAMERA)
    operator = build_operator(CONFIG, grid)
    keyframes.attached(grid, operator.encode)
    for segment in table.segments:
        segment.keyframes.attached(keyframes)
    check_segments(table, keyframes, 1000)
    return Segments(table, keyframes, operator, Config(tracking=CONFIG))


def new_segments(config: TrackingConfig = CONFIG) -> Segments:
    grid = SampleGrid(CAMERA)
    operator = build_operator(config, grid)
    store = KeyframeTable.on(grid, operator.encode)
    return Segments(SegmentTable(), store, operator, Config(tracking=config))


def run(stream: Sequence[Frame], config: TrackingConfig = CONFIG) -> tuple[Segments, list]:
    segments = new_segments(config)
    results = [segments.track(f, lambda image: ()) for f in stream]
    return segments, [*results, segments.finish()]


def turned(path: Sequence[np.ndarray], trajectory: Trajectory) -> np.ndarray:
    """Degrees by which orientations are off, relative to the first frame that is not lost."""
    truth, found = np.stack(path)[:, :3, :3], trajectory.T_wc[:, :3, :3]
    first = trajectory.states.index("tracked") if trajectory.tracked.any() else 0
    return rotation_angle(found[first].T @ found, truth[first].T @ truth)


def test_a_camera_that_only_turns_has_orientations():
    path = [pose(0.0, yaw=0.5 * np.sin(0.1 * k)) for k in range(24)]
    segments, results = run(frames(path))
    assert segments.table.why_not.startswith("The images show no parallax")
    assert results[-1].state is TrackState.INITIALIZING
    assert segments.keyframe_ids == []
    trajectory = segments.trajectory()
    assert trajectory.states == ["orientation only"] * len(path)
    assert (trajectory.T_wc[:, :3, 3] == 0).all()
    assert turned(path, trajectory).max() < 0.2


def test_a_start_that_is_far_off_is_tried_again_with_a_quarter_more(
    monkeypatch: pytest.MonkeyPatch,
):
    """A little parallax, asked for depths surer than that gives them."""
    attempts, adjustments = [], []

    def tried(graph, config, flows, most_open):
        adjustments.clear()
        attempt = initialise(graph, config, flows, 1e-3)
        if most_open == LAST_DEVIATION:  # before keyframes are given up
            return attempt
        attempts.append((len(graph.keyframes), attempt))
        if attempts[-1][1] is Attempt.FAR_OFF:
            assert len(adjustments) == FORGIVING  # no time is spent on the rest
        return attempts[-1][1]

    def adjusted(graph, *args, **options):
        adjustments.append(graph)
        return adjust(graph, *args, **options)

    adjust = FrameGraph.adjust
    monkeypatch.setattr(FrameGraph, "adjust", adjusted)
    monkeypatch.setattr(start_up, "initialise", tried)
    path = [pose(0.08 * np.sin(0.2 * k), yaw=0.3 * np.sin(0.1 * k)) for k in range(30)]
    _, results = run(frames(path), replace(CONFIG, init_keyframes=8))
    assert results[-1].state is TrackState.INITIALIZING
    assert sum(attempt is Attempt.FAR_OFF for _, attempt in attempts) >= 3
    for (before, attempt), (now, _) in pairwise(attempts):
        assert now == before + 1 or attempt is Attempt.FAR_OFF or now < before
        assert now >= 1.25 * before or attempt is not Attempt.FAR_OFF or now < before


def test_the_last_chance_is_taken_with_depths_that_are_more_open(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(start_up, "MAX_DEVIATION", 1e-3)
    path = sideways(12)
    segments, results = run(frames(path))
    assert [r.state for r in results[:-1]] == [TrackState.INITIALIZING] * (len(results) - 1)
    assert results[-1].state is TrackState.TRACKING
    trajectory = segments.trajectory()
    assert error_cm(trajectory.T_wc[:, :3, 3], np.stack(path)[:, :3, 3]) < 0.3


def test_a_video_of_few_keyframes_is_started_with_frames_between_them():
    path = [pose(-0.5 + 0.006 * k, 0.004 * np.sin(0.9 * k)) for k in range(12)]
    for started in (path, path[:3]):
        segments, results = run(frames(started))
        assert [r.state for r in results[:-1]] == [TrackState.INITIALIZING] * len(started)
        assert (results[-1].state is TrackState.TRACKING) == (started is path)
        if started is path:
            trajectory = segments.trajectory()
            assert trajectory.states == ["tracked"] * len(path)
            assert error_cm(trajectory.T_wc[:, :3, 3], np.stack(path)[:, :3, 3]) < 0.3
        else:
            assert segments.table.why_not.startswith("The camera hardly moves")


def test_a_start_does_not_believe_what_a_failed_one_held_for_moving(
    monkeypatch: pytest.MonkeyPatch,
):
    """That was judged by wrong poses: four fifths of the cells, behind a truck on a street."""
    shares = []

    def tried(graph, config, flows, most_open):
        shares.append(0.0)
        if len(shares) == 1:
            for keyframe in graph.keyframes:
                keyframe.moving = torch.ones(graph.keyframes.grid.size, dtype=torch.bool)
            return Attempt.FAILED
        found = initialise(graph, config, flows, most_open)
        judged = [k.moving for k in graph.keyframes]
        shares[-1] = max(0.0 if m is None else float(m.float().mean()) for m in judged)
        return found

    monkeypatch.setattr(start_up, "initialise", tried)
    path = sideways(12)
    segments, results = run(frames(path))
    assert results[-1].state is TrackState.TRACKING
    assert shares[1] < 0.1
    trajectory = segments.trajectory()
    assert error_cm(trajectory.T_wc[:, :3, 3], np.stack(path)[:, :3, 3]) < 0.3


@pytest.mark.parametrize(("moving", "starts"), [(0.45, True), (0.55, False)])
def test_no_map_starts_by_which_most_of_the_scene_moves(
    monkeypatch: pytest.MonkeyPatch, moving: float, starts: bool
):
    monkeypatch.setattr("geogs.tracking.start.initialise.dynamic_fraction", lambda _: moving)
    segments, _ = run(frames(sideways(12)))
    assert (segments.table.why_not == "") == starts


def test_nothing_known_is_still_an_error():
    black = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    with pytest.raises(TrackingLost, match="texture"):
        run([Frame(k, k / 30, black) for k in range(5)])


@pytest.fixture(scope="module")
def turning_away() -> tuple[list[np.ndarray], Segments, list]:
    walk = sideways(36)
    end = walk[-1]
    there = 1.05 * (1 - np.cos(np.linspace(0, np.pi, 30)))
    yaw = np.concatenate([there, there[::-1]])
    path = [*walk, *(end @ pose(0.0, yaw=a) for a in yaw), *sideways(50)[36:]]
    segments, results = run(frames(path))
    return path, segments, results


@pytest.mark.long
def test_turning_away_leaves_the_orientation(turning_away):
    path, segments, _ = turning_away
    trajectory = segments.trajectory()
    states = trajectory.states
    assert "lost" not in states
    away = [s for s, T in zip(states, path, strict=True) if abs(turn_of(T)) > 1.7]
    assert set(away) == {"orientation only"}
    assert turned(path, trajectory).max() < 0.5


@pytest.mark.long
def test_coming_back_goes_on_in_the_same_world(turning_away):
    path, segments, _ = turning_away
    trajectory = segments.trajectory()
    assert len(segments.trackers) == 1
    assert trajectory.tracked[-14:].all()
    known = trajectory.tracked
    assert 0.5 < known.mean() < 0.9
    assert error_cm(trajectory.T_wc[known, :3, 3], np.stack(path)[known, :3, 3]) < 0.6


@pytest.mark.long
def test_no_keyframe_is_made_where_no_depth_is_known(turning_away):
    path, segments, _ = turning_away
    for keyframe in segments.main.keyframes:
        assert abs(turn_of(path[keyframe.frame_index])) < 1.5


def test_frames_before_a_start_are_located_by_its_keyframes():
    looking = [pose(-0.5, yaw=0.55 * (1 - np.cos(0.27 * k))) for k in range(24)]
    path = [*looking, *sideways(20)[1:]]
    segments, _ = run(frames(path))
    trajectory = segments.trajectory()
    assert "lost" not in trajectory.states
    assert trajectory.tracked[:10].all()
    known = trajectory.tracked
    assert error_cm(trajectory.T_wc[known, :3, 3], np.stack(path)[known, :3, 3]) < 0.8
    assert turned(path, trajectory).max() < 0.6


@pytest.mark.long
def test_a_state_goes_on_as_if_nothing_had_happened():
    path = [pose(0.0, yaw=0.03 * k) for k in range(20)]
    stream = frames(path)
    whole, _ = run(stream)
    first = new_segments()
    for frame in stream[:11]:
        first.track(frame, lambda image: ())
    first.settle()
    second = resumed(copied(first.main.keyframes.table), copied(first.table))
    for frame in stream[11:]:
        second.track(frame, lambda image: ())
    second.finish()
    np.testing.assert_array_equal(second.trajectory().T_wc, whole.trajectory().T_wc)
    assert second.trajectory().states == whole.trajectory().states


def turn_of(T_wc: np.ndarray) -> float:
    """Radians about the vertical."""
    return float(np.arctan2(T_wc[0, 2], T_wc[2, 2]))
