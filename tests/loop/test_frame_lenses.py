"""Lenses that change from image to image in the adjustment of all keyframes: a planted walk."""

import numpy as np
import pytest
import torch
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.uncertainty.varying_intrinsics import VaryingPrior
from geogs.camera.straight_view import StraightView
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.loop.camera import frame_lenses
from geogs.loop.camera.frame_lenses import FrameLenses, correct_frame_lenses
from geogs.loop.global_bundle import global_bundle
from geogs.loop.keyframe_matches import KeyframeMatches
from geogs.scene_mask import SceneMask
from geogs.tracking.frame_lenses import shift_frames, shifts_of_own, sizes_of_frames
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.tracking.frames.pose_filling import solved_poses
from geogs.tracking.tracker import Tracker
from geogs.types import FlowMatch, FrameLens, SeenRows
from geogs.world.edges import pack_matches
from geogs.world.frames import FrameRecord, Observation
from geogs.world.grid import SampleGrid
from planted_walk import PlantedFlow, centre_error, true_inverse_depth, walked_tracker

CAMERA = Camera(fx=90.0, fy=90.0, cx=63.5, cy=47.5, width=128, height=96)
GRID, COUNT = SampleGrid(CAMERA), 20
NOISE = np.random.default_rng(0).integers(1, 255, (CAMERA.height, CAMERA.width), dtype=np.uint8)


def walk() -> Tensor:
    """World to camera: aside along a wall, forward and back, looking about."""
    k = np.arange(COUNT)
    xi = np.zeros((COUNT, 6))
    xi[:, 4], xi[:, 3] = 0.2 * np.sin(0.5 * k), 0.1 * np.sin(0.8 * k)
    T_wc = se3_exp(torch.from_numpy(xi))
    T_wc[:, :3, 3] = torch.from_numpy(
        np.stack([0.15 * k, 0.2 * np.sin(0.7 * k), 0.3 * np.sin(0.4 * k)], -1)
    )
    return se3_inverse(T_wc)


def camera_of(own: Tensor) -> Camera:
    focal, right, down = own.tolist()
    return CAMERA.moved(focal, right=right, down=down)


class VaryingFlow(PlantedFlow):
    """Matches between images whose lenses have something of their own."""

    def __init__(self, T: Tensor, sizes: Tensor) -> None:
        self.cameras = [camera_of(own) for own in sizes]
        grids = [SampleGrid(camera) for camera in self.cameras]
        each = [true_inverse_depth(T[n : n + 1], grid)[0] for n, grid in enumerate(grids)]
        super().__init__(GRID, T, torch.stack(each), 0.0)
        self.rays = [grid.rays for grid in grids]

    def _match(self, source, target) -> FlowMatch:
        found = [self._one(i, j) for i, j in zip(source, target, strict=True)]
        pixels, weight = (torch.stack(each) for each in zip(*found, strict=True))
        return FlowMatch(pixels, weight)

    def _one(self, i: int, j: int) -> tuple[Tensor, Tensor]:
        T = (self.T[j] @ se3_inverse(self.T[i]))[None]
        p = project(self.cameras[j], self.rays[i], T, self.d[i][None])
        used = (p.valid & GRID.inside(p.pixels))[0]
        g = torch.Generator().manual_seed(100 * i + j)
        pixels = p.pixels[0] + 0.02 * torch.randn(p.pixels[0].shape, generator=g)
        weight = torch.where(used, 400.0, 0.0)[:, None].expand(-1, 2).contiguous()
        return torch.where(used[:, None], pixels, GRID.centre), weight


def image_of(number: int) -> np.ndarray:
    return np.dstack([np.full_like(NOISE, number), np.zeros_like(NOISE), NOISE])


def sizes_of(focal: float, centre: float) -> Tensor:
    k = torch.arange(COUNT)
    each = focal * torch.sin(1.1 * k), centre * torch.cos(1.7 * k), centre * torch.sin(2.3 * k)
    return torch.stack(each, 1)


def tracker_of(sizes: Tensor) -> tuple[Tracker, Tensor]:
    T = walk()
    flow = VaryingFlow(T, sizes)
    return walked_tracker(CAMERA, flow, image_of), T


@pytest.fixture(autouse=True)
def _few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("geogs.loop.keyframe_matches.PAIRS", 4)


@pytest.mark.system
@pytest.mark.parametrize(
    ("focal", "centre"),
    [
        *(pytest.param(*s, marks=pytest.mark.long) for s in ((0.02, 0.0), (0.0, 0.012))),
        (0.02, 0.012),
    ],
)
def test_lenses_of_keyframes_are_found_and_images_straightened_by_them(monkeypatch, focal, centre):
    sizes = sizes_of(focal, centre)
    tracker, truth = tracker_of(sizes)
    with monkeypatch.context() as m:
        m.setattr(frame_lenses, "EXPLAINED", np.inf)
        global_bundle(tracker, ends=True)
    steady = centre_error(tracker, truth)
    assert not tracker.keyframes.table.frame_lenses
    tracker, truth = tracker_of(sizes)
    global_bundle(tracker, ends=True)
    assert centre_error(tracker, truth) < 0.4 * steady
    table = tracker.keyframes.table
    lens, own = table.lens, table.frame_lenses
    assert lens is not None
    found = torch.tensor([[own[n].focal, own[n].right, own[n].down] for n in range(COUNT)])
    want = sizes
    found, want = found - found.mean(0), want - want.mean(0)
    assert float((found - want).square().mean().sqrt()) < 0.45 * float(want.square().mean().sqrt())
    assert lens.varies_focal == pytest.approx(focal / 2**0.5, rel=0.3)
    assert lens.varies_centre == pytest.approx(centre, rel=0.3)  # what stays has nothing of its own
    view = StraightView(CAMERA, CAMERA, lens).of_frame(own[7])
    assert np.array_equal(tracker.keyframes[7].straight_image, view.image(image_of(7)))
    shown = SceneMask().of(tracker.keyframes[7])
    assert shown is None or np.array_equal(shown, view.is_seen)


def test_a_lens_that_stays_changes_nothing(monkeypatch):
    poses = []
    for explained in (frame_lenses.EXPLAINED, np.inf):
        monkeypatch.setattr(frame_lenses, "EXPLAINED", explained)
        tracker, _ = tracker_of(torch.zeros(COUNT, 3))
        global_bundle(tracker, ends=True)
        poses.append(tracker.keyframes.poses(range(COUNT)))
        assert tracker.keyframes.table.lens is None
    assert torch.equal(*poses)


def test_what_does_not_settle_leaves_everything_as_it_was(monkeypatch):
    tracker, _ = tracker_of(sizes_of(0.03, 0.0))
    ids = list(range(COUNT))
    graph = tracker.map.graph
    pairs = [(a, b) for a in ids for b in range(a + 1, min(a + 4, COUNT))]
    graph.measure(pairs, packed=True)
    matches = KeyframeMatches(tracker, ids[1:], ids)
    matches.adjust()
    before = tracker.keyframes.poses(ids), tracker.keyframes.inverse_depths(ids)
    edges = dict(graph.edges)
    monkeypatch.setattr(frame_lenses, "ROUNDS", 1)
    assert not correct_frame_lenses(matches)
    after = tracker.keyframes.poses(ids), tracker.keyframes.inverse_depths(ids)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert graph.edges.keys() == edges.keys()
    assert all(torch.equal(graph.edges[e].position, edges[e].position) for e in edges)


@pytest.mark.parametrize("has_rows", [False, True])
def test_what_is_ambiguous_is_left_to_the_verdict_where_rows_may_be_why(monkeypatch, has_rows):
    tracker, _ = tracker_of(sizes_of(0.0, 0.012))
    ids, graph = list(range(COUNT)), tracker.map.graph
    graph.measure([(a, b) for a in ids for b in range(a + 1, min(a + 4, COUNT))], packed=True)
    matches = KeyframeMatches(tracker, ids[1:], ids)
    matches.adjust()
    monkeypatch.setattr(frame_lenses, "AMBIGUOUS", -1.0)
    if has_rows:
        rows = SeenRows(torch.zeros(14, 18, 2).half(), torch.zeros(14, 18).half())
        tracker.map.recorder.log.rows = dict.fromkeys(ids, rows)
    assert bool(correct_frame_lenses(matches)) == has_rows


def test_where_matches_tell_nothing_more_what_was_found_stays(monkeypatch):
    tracker, _ = tracker_of(torch.zeros(COUNT, 3))
    ids = list(range(COUNT))
    tracker.map.graph.measure([(a, a + 1) for a in ids[:-1]], packed=True)
    each = {n: FrameLens(0.0, 0.001 * n, 0.0) for n in range(COUNT)}
    before = FrameLenses(each, VaryingPrior((0.0, 0.01, 0.01, 0.0)))
    monkeypatch.setattr(frame_lenses, "said_of_frame_lenses", lambda *a: [])
    found = correct_frame_lenses(KeyframeMatches(tracker, ids[1:], ids), before)
    assert found
    for n, own in found.each.items():
        assert own.sizes == pytest.approx(each[n].sizes, abs=1e-9)


@pytest.mark.parametrize("own", [(0.1, 0.0, 0.0), (0.0, 0.05, -0.03), (-0.08, 0.03, 0.04)])
def test_matches_of_lenses_of_their_own_become_those_of_one(own):
    """Whatever the sizes: where nothing is carried over, up to rounding."""
    still, lens = torch.eye(4)[None], CAMERA.moved(0.0, 0.08, -0.1)
    grid = SampleGrid(lens)
    depth = torch.full((1, GRID.size), 0.5)
    T = se3_exp(torch.tensor([[0.1, 0.05, 0.1, 0.01, 0.02, 0.0]]).double())
    seen_by = lens.moved(own[0], right=own[1], down=own[2])
    zero, sizes = torch.zeros(3), torch.tensor(own)
    at = project(lens, grid.rays, T, depth)
    there = project(seen_by, grid.rays, T, depth).pixels
    shift = shifts_of_own(lens, grid.rays, T, at, torch.stack([zero, sizes])[None])
    assert float((there + shift - at.pixels)[at.valid].abs().max()) < 2e-3
    seen = SampleGrid(seen_by).rays  # of the same cells, by the source's lens
    there = project(lens, seen, still, depth).pixels
    at = project(lens, grid.rays, still, depth)
    shift = shifts_of_own(lens, grid.rays, still, at, torch.stack([sizes, zero])[None])
    off, before = ((x - at.pixels).norm() for x in (there + shift, there))
    assert off < 1e-4 * before


def test_a_frame_between_keyframes_tells_its_own_lens():
    tracker, T = tracker_of(torch.zeros(COUNT, 3))
    for keyframe in tracker.keyframes:
        keyframe.information *= 1e4  # depths are exact
    keyframes, log = tracker.keyframes, tracker.map.recorder.log
    own = torch.tensor([0.015, 0.005, 0.0])
    pose = se3_exp(torch.tensor([0.01, 0.02, 0.0, 0.01, 0.0, 0.02]).double()) @ T[3]
    record = FrameRecord(COUNT, 0.35, 3, T[4] @ se3_inverse(T[3]))
    cells = sparse_cells(GRID)
    for k in (3, 4):
        motion = (pose @ se3_inverse(T[k]))[None]
        depth = keyframes.inverse_depths([k])[:, cells]
        p = project(camera_of(own), GRID.rays[cells], motion, depth)
        used, pixels = (p.valid & GRID.inside(p.pixels, 4.0))[0], p.pixels[0]
        weight = torch.where(used, 100.0, 0.0)[:, None].expand(-1, 2)
        record.observations.append(Observation(k, *pack_matches(GRID, pixels, weight)))
    log.records.append(record)
    zero = torch.zeros(3, dtype=torch.float64)
    known = {k.frame_index: zero for k in keyframes}
    found = sizes_of_frames(log, keyframes, known, VaryingPrior((1.0, 1.0, 1.0, 1.0)))
    np.testing.assert_allclose(found[COUNT], own, atol=2e-3)
    wrong = solved_poses(log, keyframes)[COUNT]
    shift_frames(log, keyframes, {n: FrameLens(*s.tolist()) for n, s in found.items()})
    right = solved_poses(log, keyframes)[COUNT]
    off = [float((T[:3, 3] - pose[:3, 3]).norm()) for T in (wrong, right)]
    assert off[1] < 0.2 * off[0]
