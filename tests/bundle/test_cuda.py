"""The GPU's bundle adjustment, graph and motion kernels against their PyTorch counterparts."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import geogs.bundle.cuda.dense as cuda_bundle
import geogs.bundle.cuda.fields as cuda_fields
import geogs.bundle.cuda.keyframe_pairs as cuda_pairs
import geogs.bundle.cuda.motion_only as cuda_motion
from bundle_scenes import on
from cuda_emulator import use_emulator
from geogs.bundle.dense import DenseBundle
from geogs.bundle.fields import GridFields
from geogs.bundle.keyframe_pairs import KeyframePairs
from geogs.bundle.motion_only import MotionSolver
from geogs.bundle.problem import BundleProblem, MotionProblem
from geogs.bundle.projection import MIN_Z, linearise, project, relative_motion
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.terms import DepthDamping, MeasuredDepths, MeasuredMotions
from geogs.config import Config
from geogs.geometry.camera import LEAST_SLOPE, Camera
from geogs.geometry.lie import retract, se3_exp, se3_inverse
from geogs.gpu.kernel_source import INCLUDE_FOLDER
from geogs.loop.global_bundle import global_bundle
from geogs.tracking.tracker import lone_tracker
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs.world.segments import TrackState
from lenses import LENSES
from tracking_runs import CONFIG, PATH, error_cm
from tracking_scenes import CAMERA as ROOM
from tracking_scenes import frames

SMALL = Camera(fx=50.0, fy=52.0, cx=26.0, cy=20.0, width=56, height=44)
LARGE = Camera(fx=300.0, fy=302.0, cx=255.5, cy=144.5, width=512, height=290)


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch) -> torch.device:
    """Where the kernels run; everything is emulated where there is no GPU."""
    if request.param == "emulated":
        use_emulator(monkeypatch, cuda_bundle, cuda_fields, cuda_pairs, cuda_motion)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    return torch.device("cuda")


def camera_for(device: torch.device) -> Camera:
    return LARGE if device.type == "cuda" else SMALL


@pytest.fixture(params=LENSES)
def camera(device, request) -> Camera:
    """One of each model."""
    return replace(camera_for(device), **LENSES[request.param])


def scene(camera: Camera, frames: int = 4, reach: int = 9, seed: int = 0) -> BundleProblem:
    """Nearly exact flow between views of smooth random depth, from a disturbed start."""
    g = torch.Generator().manual_seed(seed)
    grid = SampleGrid(camera)
    scale = torch.tensor([1, 1, 1, 0.3, 0.3, 0.3], dtype=torch.float64)
    T = se3_exp(0.1 * torch.randn(frames, 6, generator=g, dtype=torch.float64) * scale)
    d = 0.4 + 0.3 * torch.rand(frames, grid.size, generator=g)
    pairs = [(i, j) for i in range(frames) for j in range(frames) if 0 < abs(i - j) <= reach]
    source, target = (torch.tensor([p[k] for p in pairs]) for k in (0, 1))
    pixels = project(camera, grid.rays, relative_motion(T, source, target), d[source]).pixels
    pixels = pixels + 0.2 * torch.randn(pixels.shape, generator=g)
    weight = 0.5 + 4 * torch.rand(len(pairs), grid.size, 2, generator=g)
    weight[torch.rand(weight.shape[:2], generator=g) < 0.2] = 0
    free = torch.ones(frames, dtype=torch.bool)
    free[:2] = False
    free_depth = torch.ones(frames, dtype=torch.bool)
    free_depth[1] = False
    xi = 0.02 * torch.randn(frames, 6, generator=g, dtype=torch.float64) * free[:, None]
    start = d * (1 + 0.05 * torch.randn(d.shape, generator=g) * free_depth[:, None])
    return BundleProblem(
        retract(xi, T), start, source, target, free, free_depth, pixels=pixels, weight=weight
    )


def solve_both(
    camera: Camera, problem: BundleProblem, options: BundleOptions, device: torch.device
) -> tuple[BundleResult, BundleResult]:
    fast = cuda_bundle.CudaDenseBundle(SampleGrid(camera, device)).solve(
        on(problem, device), options
    )
    return fast, DenseBundle(SampleGrid(camera)).solve(problem, options)


def assert_same(fast: BundleResult, slow: BundleResult) -> None:
    assert fast.finite == slow.finite
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=3e-5)
    torch.testing.assert_close(fast.inverse_depth.cpu(), slow.inverse_depth, rtol=3e-4, atol=3e-5)
    torch.testing.assert_close(fast.information.cpu(), slow.information, rtol=2e-3, atol=5e-2)


def test_sources_and_python_agree_on_sizes():
    folder = Path(cuda_bundle.__file__).parent
    files = folder / "solve.cu", folder / "projection.cuh", INCLUDE_FOLDER / "lens.cuh"
    text = "".join(file.read_text() for file in files)
    found = {k: float(v) for k, v in re.findall(r"#define (\w+) ([\d.]+)", text)}
    assert found["MAX_POSES"] == cuda_bundle.MAX_FEW
    assert found["PANEL"] == cuda_bundle.PANEL
    assert found["TILE"] == cuda_bundle.TILE
    assert found["MIN_Z"] == MIN_Z
    assert found["LEAST_SLOPE"] == LEAST_SLOPE


@pytest.mark.parametrize("iterations", [1, 3])
def test_solve_matches_the_cpu(device, camera, iterations):
    problem = scene(camera)
    fast, slow = solve_both(camera, problem, BundleOptions(iterations, huber=0.5), device)
    assert_same(fast, slow)
    assert float((fast.T_cw - problem.T_cw).abs().max()) > 0.01
    assert torch.equal(fast.T_cw[:2], problem.T_cw[:2])
    assert torch.equal(fast.inverse_depth[1].cpu(), problem.inverse_depth[1])


def test_damped_depths_match_the_cpu(device):
    camera = camera_for(device)
    problem = scene(camera)
    g = torch.Generator().manual_seed(5)
    damping = 2e3 * torch.rand(problem.inverse_depth.shape, generator=g)
    damping[2] = 0
    options = BundleOptions(2, huber=0.5)
    damped = replace(problem, depth_terms=(DepthDamping(damping),))
    fast, slow = solve_both(camera, damped, options, device)
    assert_same(fast, slow)
    plain = DenseBundle(SampleGrid(camera)).solve(problem, options)
    assert float((plain.inverse_depth - slow.inverse_depth).abs().max()) > 0.01


def test_measured_depths_match_the_cpu(device):
    camera = camera_for(device)
    problem = scene(camera)
    g = torch.Generator().manual_seed(6)
    known = torch.rand(problem.inverse_depth.shape, generator=g) < 0.7
    measured = MeasuredDepths(problem.inverse_depth + 0.05, 2e3 * known)
    sensed = replace(problem, depth_terms=(measured,))
    options = BundleOptions(2, huber=0.5)
    fast, slow = solve_both(camera, sensed, options, device)
    assert_same(fast, slow)
    plain = DenseBundle(SampleGrid(camera)).solve(problem, options)
    assert float((plain.inverse_depth - slow.inverse_depth).abs().max()) > 0.01


@pytest.mark.parametrize("frames", [5, 19])
def test_measured_motions_match_the_cpu(device, frames):
    camera = camera_for(device)
    problem = scene(camera, frames=frames, reach=1)
    T, at = problem.T_cw, torch.arange(frames - 1)
    information = torch.tensor([1e6] * 3 + [1e7] * 3, dtype=torch.float64).expand(frames - 1, 6)
    off = se3_exp(0.01 * torch.ones(6, dtype=torch.float64))
    motions = MeasuredMotions(at, at + 1, off @ T[1:] @ se3_inverse(T[:-1]), information)
    told = replace(problem, pose_terms=(motions,))
    options = BundleOptions(2, huber=0.5)
    fast, slow = solve_both(camera, told, options, device)
    assert_same(fast, slow)
    plain = DenseBundle(SampleGrid(camera)).solve(problem, options)
    assert float((plain.T_cw - slow.T_cw).abs().max()) > 3e-4


def test_same_input_same_result(device):
    camera = camera_for(device)
    problem = scene(camera)
    a, b = (solve_both(camera, problem, BundleOptions(2), device)[0] for _ in range(2))
    assert torch.equal(a.T_cw, b.T_cw)
    assert torch.equal(a.inverse_depth, b.inverse_depth)


def test_solve_with_more_cells_than_threads(device):
    camera = Camera(fx=150.0, fy=152.0, cx=95.5, cy=61.5, width=192, height=124)
    problem = scene(camera, frames=3, reach=1)
    assert problem.inverse_depth.shape[1] > 256
    assert_same(*solve_both(camera, problem, BundleOptions(1, huber=0.5), device))


def test_many_poses_are_solved_panel_by_panel(device, camera):
    problem = scene(camera, frames=19, reach=1)
    fast, slow = solve_both(camera, problem, BundleOptions(1), device)
    assert int(problem.free_pose.sum()) > cuda_bundle.MAX_FEW
    assert_same(fast, slow)


def test_fixed_poses_only_move_depths(device):
    camera = camera_for(device)
    problem = scene(camera, frames=3)
    problem = replace(problem, free_pose=torch.zeros(3, dtype=torch.bool))
    fast, slow = solve_both(camera, problem, BundleOptions(2), device)
    assert_same(fast, slow)
    assert torch.equal(fast.T_cw, problem.T_cw)
    assert float((fast.inverse_depth.cpu() - problem.inverse_depth).abs().max()) > 0.01


def test_two_kinds_of_adjustment_in_turns_keep_their_structures(device):
    camera = camera_for(device)
    bundle = cuda_bundle.CudaDenseBundle(SampleGrid(camera, device))
    both = on(scene(camera, frames=3), device)
    depths = replace(both, free_pose=torch.zeros_like(both.free_pose))
    found = [bundle.structure_of(problem) for problem in (both, depths, both, depths)]
    assert [structure.poses for structure in found] == [1, 0, 1, 0]
    assert found[2] is found[0]
    assert found[3] is found[1]
    bundle.structure_of(replace(both, free_depth=torch.zeros_like(both.free_depth)))
    assert bundle.structure_of(both) is not found[0]


def test_fixed_depths_only_move_poses(device):
    camera = camera_for(device)
    problem = scene(camera, frames=3)
    problem = replace(problem, free_depth=torch.zeros(3, dtype=torch.bool))
    fast, slow = solve_both(camera, problem, BundleOptions(2), device)
    assert_same(fast, slow)
    assert torch.equal(fast.inverse_depth.cpu(), problem.inverse_depth)


def test_nothing_measured_changes_nothing(device):
    camera = camera_for(device)
    problem = scene(camera, frames=3)
    problem = replace(problem, weight=torch.zeros_like(problem.weight))
    fast, slow = solve_both(camera, problem, BundleOptions(2), device)
    assert_same(fast, slow)
    assert fast.finite
    torch.testing.assert_close(fast.inverse_depth.cpu(), problem.inverse_depth)
    assert float(fast.information.max()) == 0


def test_cells_behind_the_target_do_not_count(device):
    camera = camera_for(device)
    problem = scene(camera, frames=3)
    T = problem.T_cw.clone()
    T[2, 2, 3] -= 2.0  # depths are 1.4 to 2.5
    fast, slow = solve_both(camera, replace(problem, T_cw=T), BundleOptions(1), device)
    assert_same(fast, slow)


@pytest.mark.parametrize(("which", "count"), [("pixels", 3), ("T_cw", 3), ("pixels", 19)])
def test_not_finite_input_is_refused_and_reported(device, which, count):
    camera = camera_for(device)
    problem = scene(camera, frames=count, reach=1 if count > 3 else 2)
    bad = getattr(problem, which).clone()
    bad[-1, 0, 0] = torch.nan
    fast, _ = solve_both(camera, replace(problem, **{which: bad}), BundleOptions(2), device)
    assert not fast.finite
    torch.testing.assert_close(fast.inverse_depth.cpu(), problem.inverse_depth, rtol=0, atol=0)
    torch.testing.assert_close(
        fast.T_cw, bad if which == "T_cw" else problem.T_cw, rtol=0, atol=0, equal_nan=True
    )


def keyframes(problem: BundleProblem, camera: Camera, device: torch.device) -> KeyframeSet:
    """The frames of a problem; a fifth of their cells have no information."""
    store = KeyframeTable.on(SampleGrid(camera, device)).new_set()
    g = torch.Generator().manual_seed(5)
    image = np.zeros((4, 4, 3), np.uint8)
    for n, (T, d) in enumerate(zip(problem.T_cw, problem.inverse_depth, strict=True)):
        state = store.add(n, n / 30, image, None, T)
        known = torch.rand(d.shape, generator=g) > 0.2
        state.inverse_depth = d.to(device)
        state.information = (known * (10 + 100 * torch.rand(d.shape, generator=g))).to(device)
    return store


def smooth(problem: BundleProblem, camera: Camera) -> BundleProblem:
    """The problem with slowly varying depths, so that rounding changes no cell's neighbour much."""
    pixels = SampleGrid(camera).pixels / camera.width
    d = 0.45 + 0.1 * torch.sin(3 * pixels[:, 0]) * torch.cos(2 * pixels[:, 1])
    return replace(problem, inverse_depth=d.expand(len(problem.T_cw), -1).clone())


def test_filling_matches_the_cpu(device):
    camera = camera_for(device)
    grid, g = SampleGrid(camera, device), torch.Generator().manual_seed(0)
    values = torch.rand(4, grid.size, generator=g)
    confidence = torch.rand(4, grid.size, generator=g)
    for n, share in enumerate((0.5, 0.97, 1.1, 0.0)):
        confidence[n] *= torch.rand(grid.size, generator=g) >= share
    confidence[1, 3] = 0.5
    confidence[0, 7] = -1.0
    filled = cuda_fields.CudaFields(grid).fill(values.to(device), confidence.to(device)).cpu()
    expected = GridFields(SampleGrid(camera)).fill(values, confidence)
    torch.testing.assert_close(filled, expected, rtol=1e-5, atol=1e-6)
    assert torch.equal(filled[3], values[3])
    assert float((filled[0] - values[0]).abs().max()) > 0.1


def test_carried_depth_and_reprojections_match_the_cpu(device, camera):
    problem = smooth(scene(camera, frames=3), camera)
    store, cpu = keyframes(problem, camera, device), GridFields(SampleGrid(camera))
    slow = keyframes(problem, camera, torch.device("cpu"))
    source, target = [0, 2, 2], [1, 1, 0]
    fast = cuda_fields.CudaFields(store.grid)
    there, back = fast.reproject([store[i] for i in source], list(store.poses(target)))
    for n, (i, j) in enumerate(zip(source, target, strict=True)):
        T = relative_motion(slow.poses([i, j]), torch.tensor([0]), torch.tensor([1]))[0]
        depth, information = fast.transfer(T, store[i].inverse_depth, store[i].information)
        d, info = cpu.transfer(T, slow[i].inverse_depth, slow[i].information)
        (forward,), (backward,) = cpu.reproject([slow[i]], [slow[j].T_cw])
        torch.testing.assert_close(there[n].cpu(), forward, rtol=1e-4, atol=1e-2)
        # A cell whose position rounds the other way may fall on a neighbour.
        same = torch.isclose(depth.cpu(), d, rtol=1e-4)
        same &= torch.isclose(information.cpu(), info, rtol=1e-3, atol=1e-3)
        same &= torch.isclose(back[n].cpu(), backward, rtol=1e-3, atol=1e-1).all(-1)
        assert float(same.float().mean()) > 0.97
        assert 0.2 < float((info > 0).float().mean()) < 1


def test_motion_only_adjustment_matches_the_cpu(device, camera):
    problem = scene(camera, frames=4)
    grid = SampleGrid(camera)
    kept = (problem.source < 2) & (problem.target != problem.source)
    order = torch.randperm(int(kept.sum()), generator=torch.Generator().manual_seed(1))
    source, frame = problem.source[kept][order], problem.target[kept][order]
    slow = MotionProblem(
        problem.T_cw, problem.inverse_depth[source], problem.T_cw[source], frame,
        problem.pixels[kept][order], problem.weight[kept][order],
    )  # fmt: skip
    expected, expected_residual = MotionSolver(grid).solve(slow, 5, 0.5)
    dense = {n: getattr(slow, n).to(device) for n in ("inverse_depth", "pixels", "weight")}
    solver, sent = cuda_motion.CudaMotion(SampleGrid(camera, device)), replace(slow, **dense)
    T, residual = solver.solve(sent, 5, 0.5)
    torch.testing.assert_close(T, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(residual.cpu(), expected_residual, rtol=1e-3, atol=3e-3)
    assert float((T - problem.T_cw).abs().max()) > 0.01
    T, _ = solver.solve(replace(sent, weight=torch.zeros_like(sent.weight)), 2, 0.5)
    torch.testing.assert_close(T, problem.T_cw)


def test_fit_of_a_frame_matches_the_cpu(device, camera):
    problem = scene(camera, frames=3)
    store = keyframes(problem, camera, device)
    slow = keyframes(problem, camera, torch.device("cpu"))
    edge = int(torch.nonzero((problem.source == 0) & (problem.target == 2))[0])
    pixels, weight = problem.pixels[edge], problem.weight[edge]
    pixels[::7] += 30.0
    (expected_T, expected_motion, expected), (T, motion, found) = (
        solver(kept.grid).fit(
            problem.T_cw[2], kept[0], pixels.to(where), weight.to(where), 6, 5.0, 3.0
        )
        for solver, kept, where in (
            (MotionSolver, slow, "cpu"), (cuda_motion.CudaMotion, store, device)
        )
    )  # fmt: skip
    torch.testing.assert_close(T.cpu(), expected_T, rtol=0, atol=2e-5)
    torch.testing.assert_close(motion.cpu(), expected_motion, rtol=0, atol=3e-5)
    torch.testing.assert_close(motion.cpu() @ slow[0].T_cw, T.cpu(), rtol=0, atol=1e-9)
    used, matched, residual, flow, parallax, informed, known = found.tolist()
    share = ((weight[:, 0] > 0) & (slow[0].information > 0)).float().mean()
    assert used == pytest.approx(float(share), abs=1e-6)
    assert used == pytest.approx(float(expected[0]), abs=1e-6)
    assert matched == pytest.approx(float(expected[1]), abs=1.5 / len(weight))
    assert matched < used
    assert residual == pytest.approx(float(expected[2]), rel=1e-3)
    assert flow == pytest.approx(float(expected[3]), rel=1e-5)
    assert parallax == pytest.approx(float(expected[4]), rel=1e-3)
    assert 0.05 * flow < parallax != flow
    assert informed == pytest.approx(float((slow[0].information > 0).float().mean()), abs=1e-6)
    placed = slow[0].has_known_depth & (weight[:, 0] > 0)
    assert known == pytest.approx(float(placed.float().mean()), abs=1.5 / len(weight))
    assert known == pytest.approx(float(expected[6]), abs=1.5 / len(weight))
    assert 0 < known < used < informed < 1


def test_pairs_of_keyframes_match_the_cpu(device, camera):
    problem = scene(camera, frames=4)
    # The last looks the other way, the third from far to the side.
    problem.T_cw[3] = se3_exp(torch.tensor([0, 0, 0, 0, 3.0, 0], dtype=torch.float64))
    problem.T_cw[2, 0, 3] += 1.5
    slow = keyframes(problem, camera, torch.device("cpu"))
    fast = keyframes(problem, camera, device)
    directed = [(i, j) for i in range(4) for j in range(4) if i != j]
    pairs, expected = cuda_pairs.CudaPairs(fast, directed), KeyframePairs(slow, directed)
    before = expected.project()
    torch.testing.assert_close(pairs.project().cpu(), before, rtol=1e-3, atol=1e-2)

    distance = expected.distances(0.3)
    assert 0 < int(torch.isinf(distance).sum()) < len(directed)
    torch.testing.assert_close(pairs.distances(0.3).cpu(), distance, rtol=1e-4, atol=1e-3)

    g = torch.Generator().manual_seed(2)
    earlier = before + 3 * torch.randn(before.shape, generator=g)
    weight = (torch.rand(before.shape, generator=g) > 0.4).float()
    weight[4] = 0
    weight[before.abs().amax(-1) > 1e3] = 0  # of which single precision leaves no pixels
    motion = expected.moved(earlier, weight)
    assert torch.isnan(motion[4])
    moved = pairs.moved(earlier.to(device), weight.to(device)).cpu()
    torch.testing.assert_close(moved, motion, rtol=1e-3, atol=1e-3, equal_nan=True)


def test_uncertain_observations_linearise_on_the_device(device):
    """The recorder linearises with poses on the CPU and depths on the device."""
    camera = camera_for(device)
    problem = scene(camera, frames=3)
    grid = SampleGrid(camera, device)
    T = relative_motion(problem.T_cw, problem.source, problem.target)
    p = linearise(camera, grid.rays, T, problem.inverse_depth[problem.source].to(device))
    assert p.depth_jacobian.device.type == device.type


@pytest.mark.gpu
def test_tracker_runs_on_the_gpu_as_on_the_cpu():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    tracker = lone_tracker(ROOM, Config(tracking=CONFIG), device="cuda")
    states = [tracker.track(f).state for f in frames(PATH)]
    tracker.finish()
    assert TrackState.LOST not in states
    trajectory = tracker.trajectory()
    truth = np.stack(PATH)[:, :3, 3]
    assert trajectory.tracked.all()
    assert error_cm(trajectory.T_wc[:, :3, 3], truth) < 0.5
    keyframe = tracker.keyframes[tracker.segment.ids[0]]
    assert keyframe.T_cw.device.type == "cpu"
    assert keyframe.inverse_depth.device.type == "cuda"
    global_bundle(tracker)
    assert error_cm(tracker.trajectory().T_wc[:, :3, 3], truth) < 0.3
