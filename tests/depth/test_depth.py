"""The dense keyframe depth as a whole, on a rendered wall with a ball."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from depth_scene import RENDER, WORKING, DepthScene, make_scene
from geogs import threads
from geogs.config import DepthConfig
from geogs.depth.carve import vote
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.depth_engine import DepthTask
from geogs.depth.depth_view import DenseDepth, KeyframeDepth, PosedDepth, ViewPose
from geogs.depth.estimate import estimate_depth
from geogs.depth.fusion import check_depth
from geogs.depth.sweep_neighbors import depth_range, select_sweep_neighbours, view_pairs


@pytest.fixture(scope="module")
def scene() -> DepthScene:
    return make_scene()


@pytest.fixture(scope="module")
def depths(scene: DepthScene) -> list[KeyframeDepth]:
    return [_estimate(scene, i) for i in range(len(scene.views))]


def _estimate(scene: DepthScene, i: int) -> KeyframeDepth:
    others = [v for v in scene.views if v.id != i]
    return estimate_depth(scene.views[i], others, RENDER, WORKING)


def _relative_error(depth: KeyframeDepth, truth: np.ndarray) -> np.ndarray:
    return np.abs(depth.depth / truth - 1.0)


def test_depth_is_accurate_and_confidence_separates_right_from_wrong(scene, depths):
    pairs = zip(depths, scene.truth, strict=True)
    error = np.concatenate([_relative_error(d, t).ravel() for d, t in pairs])
    confidence = np.concatenate([d.confidence.ravel() for d in depths])
    assert np.median(error) < 0.004
    assert error.mean() < 0.02
    sure = confidence > 0.5
    assert sure.mean() > 0.6
    assert (error[sure] < 0.02).mean() > 0.93
    assert (error[sure] > 0.05).mean() < 0.03
    assert error[sure].mean() < 0.3 * error[~sure].mean()


def test_depth_does_not_depend_on_the_number_of_threads(scene, depths, monkeypatch):
    for count in (1, 3):
        monkeypatch.setattr(threads, "worker_count", lambda count=count: count)
        again = _estimate(scene, 1)
        assert np.array_equal(again.depth, depths[1].depth)
        assert np.array_equal(again.confidence, depths[1].confidence)


def test_depth_beats_the_trackers_own_by_far(scene, depths):
    view, truth = scene.views[0], scene.truth[0]
    grid = truth[2:-1:4, 2:-1:4]
    tracker = np.abs(1.0 / view.inverse_depth[: grid.shape[0], : grid.shape[1]] / grid - 1.0)
    assert np.median(_relative_error(depths[0], truth)) < 0.2 * np.median(tracker)


def test_result_is_the_same_again_and_in_threads(scene, depths):
    with ThreadPoolExecutor(2) as pool:
        again = list(pool.map(lambda i: _estimate(scene, i), range(2)))
    for a, b in zip(again, depths, strict=False):
        assert np.array_equal(a.depth, b.depth)
        assert np.array_equal(a.confidence, b.confidence)


def test_scaling_the_world_scales_the_depth(scene, depths):
    scale = 7.0
    scaled = []
    for view in scene.views:
        T_cw = view.T_cw.copy()
        T_cw[:3, 3] *= scale
        inverse, information = view.inverse_depth / scale, view.information * scale**2
        inverse, information = inverse.astype(np.float32), information.astype(np.float32)
        scaled.append(replace(view, T_cw=T_cw, inverse_depth=inverse, information=information))
    depth = estimate_depth(scaled[0], scaled[1:], RENDER, WORKING)
    same = np.abs(depth.depth / scale / depths[0].depth - 1.0) < 1e-3
    assert same.mean() > 0.98


def test_without_neighbours_the_completed_tracker_remains(scene):
    depth = estimate_depth(scene.views[0], [], RENDER, WORKING)
    assert np.median(_relative_error(depth, scene.truth[0])) < 0.02
    assert depth.confidence.max() <= 0.5


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_bad_tracker_values_do_no_harm(scene, value):
    view = scene.views[0]
    inverse = view.inverse_depth.copy()
    inverse[:3, 4:9] = value
    broken = replace(view, inverse_depth=inverse)
    depth = estimate_depth(broken, scene.views[1:], RENDER, WORKING)
    assert np.isfinite(depth.depth).all()
    assert (depth.depth > 0).all()
    assert np.median(_relative_error(depth, scene.truth[0])) < 0.005


@pytest.mark.parametrize("how", ["nothing known", "all nan", "black images"])
def test_hopeless_input_gives_finite_unsure_depth(scene, how):
    views = scene.views
    nothing = np.zeros_like(views[0].information)
    if how == "nothing known":
        views = [replace(v, information=nothing) for v in views]
    elif how == "all nan":
        views = [replace(v, inverse_depth=nothing + np.float32(np.nan)) for v in views]
    if how != "nothing known":
        black = {"grey": 0 * views[0].grey, "fine": 0 * views[0].fine, "image": 0 * views[0].image}
        views = [replace(v, information=nothing, **black) for v in views]
    depth = estimate_depth(views[0], views[1:], RENDER, WORKING)
    assert np.isfinite(depth.depth).all()
    assert np.isfinite(depth.confidence).all()
    assert (depth.depth > 0).all()
    if how != "nothing known":
        assert (depth.confidence < 0.5).all()


def test_check_lowers_the_confidence_of_a_floater_and_averages_noise(scene, depths):
    rng = np.random.default_rng(3)
    truth = scene.truth
    noisy = [t * (1 + 0.004 * rng.standard_normal(t.shape)).astype(np.float32) for t in truth]
    clean = [KeyframeDepth(z, np.full_like(z, 0.8)) for z in noisy]
    wrong = noisy[0].copy()
    wrong[5:12, 5:12] *= 0.7
    poses = [v.T_cw for v in scene.views]
    checked = check_depth(
        KeyframeDepth(wrong, clean[0].confidence), poses[0], clean[1:], poses[1:], RENDER
    )
    assert checked.confidence[5:12, 5:12].max() < 0.2
    inner = np.zeros_like(wrong, bool)
    inner[16:-8, 8:-8] = True
    assert (checked.confidence[inner] > 0.8).mean() > 0.85
    before = np.abs(wrong / truth[0] - 1.0)[inner].mean()
    assert np.abs(checked.depth / truth[0] - 1.0)[inner].mean() < 0.7 * before


def test_the_cpu_engine_is_the_functions(scene, depths):
    engine = CpuDepthEngine(RENDER, WORKING, DepthConfig.planes)
    views = scene.views
    dense = engine.estimate(
        [DepthTask(views[i], [v for v in views if v.id != i]) for i in range(2)]
    )
    posed = [PosedDepth(v.T_cw, DenseDepth.of(d)) for v, d in zip(views, depths, strict=True)]
    for got, expected in zip(dense, depths, strict=False):
        assert np.array_equal(got.depth.numpy(), expected.depth)
        assert np.array_equal(got.confidence.numpy(), expected.confidence)
        assert got.typical == np.median(expected.depth)
    checked, alone = engine.check(posed[:2], [posed[1:], []])
    poses = [v.T_cw for v in views]
    expected = check_depth(depths[0], poses[0], depths[1:], poses[1:], RENDER)
    assert np.array_equal(checked.arrays().depth, expected.depth)
    assert np.array_equal(checked.arrays().confidence, expected.confidence)
    assert alone is posed[1].depth
    doubled = alone.scaled(2.0)
    assert doubled.typical == pytest.approx(2 * alone.typical)
    assert torch.equal(doubled.depth, 2 * alone.depth)
    points = torch.rand(200, 3) * 3
    kept = engine.keep(points, posed)
    assert np.array_equal(
        kept.numpy(), vote(points.numpy(), zip(poses, depths, strict=True), RENDER)
    )
    assert 0 < int(kept.sum()) < 200


def test_pairs_are_judged_by_what_both_see(scene):
    reference = ViewPose(0, np.eye(4))
    aside, turned, ahead = np.eye(4), np.eye(4), np.eye(4)
    aside[0, 3] = -0.2
    turned[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    ahead[2, 3] = -0.5
    others = [ViewPose(n + 1, T_cw) for n, T_cw in enumerate((aside, turned, ahead))]
    pairs = view_pairs(reference, others, 2.0, RENDER)
    # Seen slantwise, 0.2 aside of 2 m of depth is a little less than its 5.7 degrees ahead.
    assert pairs.parallax[0] == pytest.approx(np.degrees(np.arctan(0.1)), rel=0.15)
    assert pairs.overlap[0] >= 0.8
    assert pairs.zoom[0] == pytest.approx(1.0, abs=0.03)
    assert pairs.rotation[:2] == pytest.approx([0.0, 90.0], abs=1e-3)
    assert pairs.overlap[1] == pairs.parallax[1] == 0
    # A point ahead shows a camera that moves straight on no parallax, those around do.
    assert pairs.parallax[2] > 2
    assert pairs.zoom[2] == pytest.approx(2.0 / 1.5, rel=0.05)
    assert pairs.usable(1.0, 25.0).tolist() == [True, False, True]


def test_parallax_agrees_with_the_angle_of_each_point(scene):
    """The medians against rays that are made and measured one by one."""
    random = np.random.default_rng(3)
    axis = random.normal(0, 0.15, 3)
    T_cw = np.eye(4)
    T_cw[:3, :3] = Rotation.from_rotvec(axis).as_matrix()
    T_cw[:3, 3] = random.normal(0, 0.2, 3)
    pairs = view_pairs(ViewPose(0, np.eye(4)), [ViewPose(1, T_cw)], 3.0, RENDER)
    angles, zooms, seen = [], [], 0
    centre = -T_cw[:3, :3].T @ T_cw[:3, 3]
    for i in range(9):
        for j in range(9):
            u, v = (i + 0.5) * RENDER.width / 9 - 0.5, (j + 0.5) * RENDER.height / 9 - 0.5
            point = 3.0 * np.array([(u - RENDER.cx) / RENDER.fx, (v - RENDER.cy) / RENDER.fy, 1.0])
            x, y, z = T_cw[:3, :3] @ point + T_cw[:3, 3]
            px, py = RENDER.fx * x / z + RENDER.cx, RENDER.fy * y / z + RENDER.cy
            if not (0 <= px <= RENDER.width - 1 and 0 <= py <= RENDER.height - 1):
                continue
            seen += 1
            there = point - centre
            cosine = point @ there / np.linalg.norm(point) / np.linalg.norm(there)
            angles.append(np.degrees(np.arccos(cosine)))
            zooms.append(abs(np.log(np.linalg.norm(there) / np.linalg.norm(point))))
    assert 20 < seen < 81
    assert pairs.overlap[0] == pytest.approx(seen / 81)
    assert pairs.parallax[0] == pytest.approx(sorted(angles)[seen // 2])
    assert np.log(pairs.zoom[0]) == pytest.approx(sorted(zooms)[seen // 2])


def test_a_camera_that_moves_straight_on_is_matched_with_those_next_to_it():
    """With the angle at the point ahead alone the farthest were taken, up to past what is seen."""

    def at(n: int) -> ViewPose:
        T_cw = np.eye(4)
        T_cw[2, 3] = -1.2 * n
        return ViewPose(n, T_cw)

    views = [at(n) for n in range(40)]
    chosen = select_sweep_neighbours(views[20], views, 12.0, RENDER)
    assert len(chosen) == 8
    assert sorted(chosen) == [15, 16, 17, 18, 19, 21, 22, 23]


def test_neighbours_have_parallax_look_the_same_way_and_spread(scene):
    view = scene.views[0]

    def moved(i: int, x: float, y: float, turn: float = 0.0):
        T_wc = np.eye(4)
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        T_wc[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        T_wc[:3, 3] = [x, y, 0]
        return replace(view, id=i, T_cw=np.linalg.inv(T_wc))

    reference = moved(0, 0, 0)
    few = [reference, moved(1, 0.005, 0), moved(2, 0.2, 0), moved(3, 0.2, 0, 50), moved(4, 3, 0)]
    assert select_sweep_neighbours(reference, few, 2.0, RENDER) == [2]
    lonely = [reference, moved(1, 0.001, 0), moved(2, 0.002, 0)]
    assert len(select_sweep_neighbours(reference, lonely, 2.0, RENDER)) == 2
    sideways = [moved(i, 0.2 + 0.001 * i, 0) for i in range(1, 5)]
    upwards = moved(9, 0, 0.3)
    chosen = select_sweep_neighbours(reference, [*sideways, upwards], 2.0, RENDER, 2)
    assert 4 in chosen


def test_depth_range_covers_the_scene_and_ignores_the_unsure(scene):
    near, far = depth_range(scene.views[0], scene.views[1:], WORKING)
    truth = scene.truth[0]
    assert near < truth.min()
    assert far > np.percentile(truth, 99)
    assert near > 0.5 * truth.min()
    assert far < 2.0 * truth.max()


def test_unsure_pixels_take_what_the_others_agree_on(scene, depths):
    truth, poses = scene.truth, [v.T_cw for v in scene.views]
    others = [KeyframeDepth(t, np.full_like(t, 0.9)) for t in truth[1:]]
    wrong, confidence = 1.6 * truth[0], np.full_like(truth[0], 0.1)
    hidden = KeyframeDepth(wrong.astype(np.float32), confidence)
    checked = check_depth(hidden, poses[0], others, poses[1:], RENDER)
    error = np.abs(checked.depth / truth[0] - 1.0)[8:-8, 12:-12]
    assert (error < 0.02).mean() > 0.95
    assert (checked.confidence[8:-8, 12:-12] > 0.5).mean() > 0.9
    sure = KeyframeDepth(hidden.depth, np.full_like(confidence, 0.9))
    kept = check_depth(sure, poses[0], others, poses[1:], RENDER)
    assert np.abs(kept.depth / hidden.depth - 1.0).max() < 0.02
