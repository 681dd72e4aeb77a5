"""Rows in the adjustment of all keyframes: a hall that is read row by row, with exact matches."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.protocols import BundleOptions
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse, se3_log
from geogs.geometry.umeyama import umeyama
from geogs.loop.camera.rows import (
    FIRST_STEP,
    _readout_gradient,
    _Search,
    correct_rows,
    let_lenses_move,
)
from geogs.loop.global_bundle import global_bundle
from geogs.loop.keyframe_matches import GLOBAL_OPTIONS, KeyframeMatches
from geogs.tracking.frame_uncertainty import frame_uncertainty
from geogs.tracking.frames.pose_filling import row_errors, rows_in_doubt
from geogs.tracking.frames.row_errors import RowErrors, edge_shifts
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.keyframe_uncertainty import keyframe_uncertainty
from geogs.tracking.row_twists import part_seen, row_twists
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import FlowMatch, FrameLens, SeenRows
from geogs.world.edges import edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.segments import TrackState
from planted_walk import PlantedFlow, true_inverse_depth

CAMERA = Camera(fx=90.0, fy=90.0, cx=47.5, cy=35.5, width=96, height=72)
GRID = SampleGrid(CAMERA)
COUNT, RATE, READOUT = 8, 30.0, 0.02


def pose(k: np.ndarray) -> Tensor:
    """World to camera at numbers of frames, which need not be whole."""
    xi = np.zeros((len(k), 6))
    xi[:, 3], xi[:, 4] = 0.03 * np.sin(0.9 * k), 0.1 + 0.05 * np.sin(0.6 * k)
    T_wc = se3_exp(torch.from_numpy(xi))
    T_wc[:, :3, 3] = torch.from_numpy(
        np.stack([0.06 * k, 0.02 * np.sin(0.8 * k), 0.03 * np.sin(0.5 * k)], -1)
    )
    return se3_inverse(T_wc)


def row_times(v: Tensor) -> Tensor:
    """Seconds from the middle row."""
    return READOUT * (v / (CAMERA.height - 1) - 0.5)


def sway(k: np.ndarray) -> Tensor:
    """Where a stabilised lens is at numbers of frames, in focal lengths."""
    return torch.from_numpy(np.stack([0.01 * np.sin(1.1 * k), 0.008 * np.cos(0.9 * k)], -1))


def drift(frame: int, times: Tensor) -> Tensor:
    """How far it has moved since the frame's own time, of rows at these seconds: nothing."""
    return torch.zeros(len(times), 2, dtype=torch.float64)


class RollingFlow(PlantedFlow):
    """Exact matches between images whose rows were left as they were read."""

    def _match(self, source, target) -> FlowMatch:
        found = [self._one(i, j) for i, j in zip(source, target, strict=True)]
        pixels = torch.stack(found).float()
        weight = torch.where(GRID.inside(pixels), 400.0, 0.0)
        return FlowMatch(pixels, weight[..., None].expand(-1, -1, 2).contiguous())

    def _one(self, i: int, j: int) -> Tensor:
        world, pixels = self._points(i), GRID.pixels.double()
        for _ in range(4):
            times = row_times(pixels[:, 1])
            T = pose(j + RATE * times.numpy())
            seen = (T[:, :3, :3] @ world[..., None])[..., 0] + T[:, :3, 3]
            plane = seen[:, :2] / seen[:, 2:] + drift(j, times)
            pixels = plane * CAMERA.fx + torch.tensor([CAMERA.cx, CAMERA.cy])
        return pixels

    @functools.cache  # noqa: B019
    def _points(self, i: int) -> Tensor:
        """What the cells of an image see, in the world."""
        rows = GRID.pixels.reshape(GRID.height, GRID.width, 2)[:, 0, 1].double()
        T = pose(i + RATE * row_times(rows).numpy())
        depth = 1 / true_inverse_depth(T, GRID).reshape(-1, GRID.height, GRID.width).double()
        own = depth[range(GRID.height), range(GRID.height)]
        rays = GRID.rays.reshape(GRID.height, GRID.width, 3).double().clone()
        rays[..., :2] -= drift(i, row_times(rows))[:, None]
        points = rays * own[..., None]
        return ((points - T[:, None, :3, 3]) @ T[:, :3, :3]).reshape(-1, 3)


def as_read(factor: float = 1.0, doubt: float = 0.0) -> SeenRows:
    """Rows that nothing was done about, by a readout so many times as long as it is."""
    v = torch.arange(-1, CAMERA.height // 8 + 1) * 8 + 3.5
    seconds = factor * row_times(v)[:, None].repeat(1, CAMERA.width // 8 + 2)
    return SeenRows(torch.zeros(*seconds.shape, 2).half(), seconds.half(), doubt)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    options = replace(GLOBAL_OPTIONS, iterations=5)
    for name, value in (("ROUNDS", 1), ("PAIRS", 4), ("GLOBAL_OPTIONS", options)):
        monkeypatch.setattr(f"geogs.loop.keyframe_matches.{name}", value)


def tracker_of_rows(rows: SeenRows) -> Tracker:
    """A tracker with the true poses and depths of the middle rows, and matches as they are read."""
    T = pose(np.arange(COUNT))
    d = true_inverse_depth(T, GRID)
    tracker = lone_tracker(CAMERA, operator=RollingFlow(GRID, T, d, 0.0))
    for n in range(COUNT):
        image = np.full((4, 4, 3), (n, 0, 0), np.uint8)
        state = tracker.keyframes.add(n, n / RATE, image, n, T[n].clone())
        state.inverse_depth, state.information = d[n].clone(), torch.full_like(d[n], 1e4)
        tracker.map.recorder.add_keyframe(state)
        tracker.segment.frames.rows[n] = rows
    tracker.segment.status.state = TrackState.TRACKING
    return tracker


def error(T_cw: Tensor) -> float:
    """Mean error of the steps between keyframes, as a part of the whole way."""
    found, true = (se3_inverse(T)[:, :3, 3] for T in (T_cw, pose(np.arange(COUNT))))
    steps, others = ((c[1:] - c[:-1]) / (c[-1] - c[0]).norm() for c in (found, true))
    return float((steps - others).norm(dim=1).mean())


def test_the_trajectory_straightens_rows_that_nothing_was_done_about(monkeypatch):
    tracker, bent = tracker_of_rows(as_read()), []

    def settle(matches, **more):
        bent.append(error(matches.keyframes.poses(matches.keyframes.ids)))
        return correct_rows(matches, **more)

    monkeypatch.setattr("geogs.loop.global_bundle.correct_rows", settle)
    global_bundle(tracker)
    assert bent[0] > 0.05
    assert error(tracker.keyframes.poses(tracker.keyframes.ids)) < 0.4 * bent[0]


@pytest.mark.parametrize("moves", [False, True])
def test_rows_tell_whether_a_lens_moved_while_they_were_read(monkeypatch, moves):
    monkeypatch.setitem(globals(), "READOUT", 0.01)  # no row is off by what is not believed
    if moves:
        monkeypatch.setitem(
            globals(), "drift",
            lambda n, times: sway(n + RATE * times.numpy()) - sway(np.array([n])),
        )  # fmt: skip
    tracker = tracker_of_rows(as_read())
    graph, log = tracker.map.graph, tracker.segment.frames
    graph.measure(
        [(i, j) for i in range(COUNT) for j in range(i + 1, min(i + 4, COUNT))], packed=True
    )
    own = {n: FrameLens(0.0, *sway(np.array(n)).tolist()) for n in range(COUNT)}
    still = row_errors(log, tracker.keyframes)
    moving = still.with_lenses(own)
    part = part_seen(still, moving, tracker.keyframes, graph.edges, log)
    assert part == pytest.approx(float(moves), abs=0.3)
    let_lenses_move(KeyframeMatches(tracker, [], []), own)
    assert log.lenses == (own if moves else {})
    errors = row_errors(log, tracker.keyframes)
    for pairs, (shift, _) in edge_shifts(errors, tracker.keyframes, graph.packed):
        pixels, weight = edge_matches(GRID, [graph.edges[pair] for pair in pairs])
        T, depth = (
            tracker.keyframes.relative_poses(pairs),
            tracker.keyframes.inverse_depths([i for i, _ in pairs]),
        )
        off = (pixels + shift - project(CAMERA, GRID.rays, T, depth).pixels)[weight[..., 0] > 0]
        assert float(off.norm(dim=-1).median()) < 0.03


@pytest.mark.parametrize("are_corrected", [False, True])
def test_a_knock_between_images_is_told_by_the_rows_of_a_frame(monkeypatch, are_corrected):
    even, frame = pose, 4

    def knocked(k: np.ndarray) -> Tensor:
        xi = np.zeros((len(k), 6))
        xi[:, 4] = 0.03 * np.clip(k - frame, 0, None) ** 2
        return se3_exp(torch.from_numpy(xi)) @ even(k)

    monkeypatch.setitem(globals(), "pose", knocked)
    tracker = tracker_of_rows(as_read())
    graph, keyframes, log = tracker.map.graph, tracker.keyframes, tracker.segment.frames
    graph.measure([(2, frame), (3, frame), (5, frame)], packed=True)
    errors = row_errors(log, keyframes)
    assert errors is not None
    edges = dict(graph.edges)
    if are_corrected:
        for part, (shift, _) in edge_shifts(errors, keyframes, graph.edges):
            edges |= {e: edges[e].moved(CAMERA, s) for e, s in zip(part, shift, strict=True)}
    twists = row_twists(errors, keyframes, edges, log, are_corrected)
    found = twists.twist[twists.frames.index(frame)]

    def moved(k: np.ndarray) -> np.ndarray:
        return se3_log(knocked(k) @ se3_inverse(knocked(np.array([float(frame)])))).numpy()

    around, read = np.arange(-2.0, 3), RATE * READOUT * np.linspace(-0.5, 0.5, 41)
    course = np.stack([np.polyval(np.polyfit(around, x, 4), read) for x in moved(frame + around).T])
    missed = RATE * (read @ (moved(frame + read) - course.T)) / (read @ read)
    assert abs(missed[4]) > 0.1
    np.testing.assert_allclose(found.numpy()[3:], missed[3:], atol=0.3 * abs(missed[4]))


def test_what_rows_leave_open_is_in_the_deviations_of_frames():
    tracker = tracker_of_rows(as_read())
    global_bundle(tracker)
    graph, log = tracker.map.graph, tracker.segment.frames
    errors = row_errors(log, tracker.keyframes)
    assert errors is not None
    found = row_twists(errors, tracker.keyframes, graph.edges, log, True)
    by_rows = [found.leaves_open[found.frames.index(n)] for n in range(COUNT)]
    around, known = keyframe_uncertainty(tracker), frame_uncertainty(tracker)
    for one in ("position", "rotation"):
        rows = [getattr(deviation, one) for deviation in by_rows]
        assert min(rows) > 0
        np.testing.assert_allclose(getattr(known, one), np.hypot(getattr(around, one), rows))
    log.rows.clear()
    np.testing.assert_allclose(frame_uncertainty(tracker).position, around.position)


def test_the_gradient_falls_to_zero_at_the_true_readout():
    """With the true poses and depths, and rows that count as read 1.15 times as slowly."""
    tracker = tracker_of_rows(as_read(1.15, doubt=10.0))
    graph, pairs = tracker.map.graph, [(n, n + 1) for n in range(COUNT - 1)]
    graph.measure(pairs, packed=True)
    errors = row_errors(tracker.segment.frames, tracker.keyframes)
    assert errors.doubt == 10.0
    matches = KeyframeMatches(tracker, [], [], options=BundleOptions())
    at = [
        _readout_gradient(matches, graph.edges, errors.with_readout(factor), factor)
        for factor in (0.8, 1 / 1.15, 1.0)
    ]
    assert at[0] < 0 < at[2]
    assert abs(at[1]) < 0.05 * at[2]


@pytest.mark.parametrize("doubt", [0.0, 0.1])
def test_a_readout_is_doubted_however_far_frames_are_apart(doubt):
    tracker = tracker_of_rows(as_read(1.15, doubt=doubt))
    log, keyframes = tracker.map.recorder.log, tracker.keyframes
    for record in log.records:
        record.timestamp *= 0.5 * (COUNT - 1) / log.records[-1].timestamp
    near = row_errors(log, keyframes)
    assert near.doubt == 0  # poses two a second do not say what rows have seen
    doubted = rows_in_doubt(log, keyframes, near)
    assert (None if doubted is None else doubted.doubt) == (doubt or None)


@pytest.mark.parametrize(
    ("doubt", "finds_readout", "kept"), [(0.0, True, True), (0.1, False, True), (0.1, True, False)]
)
def test_a_readout_that_was_told_is_kept_and_one_that_is_not_to_be_found(
    monkeypatch, doubt, finds_readout, kept
):
    tracker, factors = tracker_of_rows(as_read(1.15, doubt=doubt)), set()
    given = RowErrors.with_readout

    def noted(errors, factor):
        factors.add(factor)
        return given(errors, factor)

    monkeypatch.setattr(RowErrors, "with_readout", noted)
    tracker.map.graph.measure([(0, 1), (1, 2)], packed=True)
    correct_rows(KeyframeMatches(tracker, [1, 2], [0, 1, 2]), finds_readout)
    assert (factors == {1.0}) == kept


def test_a_search_ends_where_the_gradient_is_zero():
    search = _Search()
    for _ in range(3):
        search.step(40 * (search.factor - 0.9))
    assert search.factor == pytest.approx(0.9)


def test_a_search_without_a_minimum_stays():
    search = _Search()
    for _ in range(2):
        search.step(-3 * (search.factor - 0.9))
    assert search.factor == 1.0


def test_nothing_happens_to_a_global_shutter():
    tracker = tracker_of_rows(as_read())
    tracker.segment.frames.rows.clear()
    tracker.map.graph.measure([(0, 1)], packed=True)
    before = tracker.map.graph.edges[0, 1].position.clone()
    correct_rows(KeyframeMatches(tracker, [1], [0, 1]))
    assert torch.equal(tracker.map.graph.edges[0, 1].position, before)
    assert torch.equal(tracker.keyframes[1].T_cw, pose(np.arange(COUNT))[1])


@pytest.mark.parametrize(
    ("doubt", "best", "steps"),
    [(0.0, None, [4, 10]), (0.1, 0.9, [4, 4, 4, 10]), (0.1, 1 - FIRST_STEP, [4, 4, 10])],
    ids=["a readout that was told", "one that is far", "one that the first trial finds"],
)
def test_only_the_last_adjustment_is_a_long_one(monkeypatch, doubt, best, steps):
    tracker, taken = tracker_of_rows(as_read(1.15, doubt=doubt)), []
    given = FrameGraph.adjust

    def noted(graph, edges, free_pose, free_depth, options):
        taken.append(options.iterations)
        return given(graph, edges, free_pose, free_depth, options)

    monkeypatch.setattr(FrameGraph, "adjust", noted)
    monkeypatch.setattr(
        "geogs.loop.camera.rows._readout_gradient",
        lambda matches, measured, errors, factor: 40 * (factor - best) ** 3,
    )
    tracker.map.graph.measure([(0, 1), (1, 2)], packed=True)
    correct_rows(KeyframeMatches(tracker, [1, 2], [0, 1, 2]))
    assert taken == steps


def test_a_readout_that_nobody_found_is_in_the_deviations(monkeypatch):
    """By what rows that count as seen at once really do to the poses; not where it was told."""
    monkeypatch.setattr("geogs.bundle.uncertainty.lens_error.PRIOR", (1e-9, 1e-9, 1e-9))
    tracker = tracker_of_rows(as_read())
    log, ids = tracker.segment.frames, tracker.keyframes.ids
    log.rows.clear()
    global_bundle(tracker)
    found, true = (
        se3_inverse(T)[:, :3, 3] for T in (tracker.keyframes.poses(ids), pose(np.arange(COUNT)))
    )
    scale, R, t = umeyama(found, true)
    off = float((scale * found @ R.T + t - true).norm() / scale)
    monkeypatch.setattr("geogs.tracking.keyframe_uncertainty.USUAL_RESIDUAL", np.inf)
    told = np.linalg.norm(keyframe_uncertainty(tracker).position)
    log.open_rows = replace(as_read(doubt=1.0), is_rectified=False)
    left_open = np.linalg.norm(keyframe_uncertainty(tracker).position)
    assert told < 0.1 * off
    assert 0.5 * off < left_open < 1.5 * off
