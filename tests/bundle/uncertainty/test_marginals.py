"""Marginal variances against the inverse of the full normal equations, and against samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bundle_scenes import CAMERA, scene
from geogs.bundle.dense import DenseBundle
from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.projection import project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty import marginals as room
from geogs.bundle.uncertainty.marginals import (
    ALIKE,
    COMMON_FLOW,
    COMMON_PLACE,
    DEPTHS_ALIKE,
    Marginals,
    common_errors,
    deviations_after_alignment,
    marginals,
)
from geogs.evaluation.rotation_errors import best_rotation, rotation_angle
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse, se3_log
from geogs.geometry.robust import weighted_median
from geogs.geometry.umeyama import umeyama
from geogs.world.grid import SampleGrid
from oracles.bundle_reference import residuals

EXACT = BundleOptions(huber=50.0, depth_damping=0.0)


def full_covariance(problem: BundleProblem, grid: SampleGrid):
    """Inverse of the normal equations over free poses and all depths, by autograd."""
    n, p = problem.inverse_depth.shape
    zero = torch.zeros(n, 6, dtype=torch.float64), torch.zeros(n, p, dtype=torch.float64)
    Jx, Jd = torch.func.jacrev(
        lambda a, b: residuals(problem, CAMERA, grid.rays, a, b).reshape(-1), (0, 1)
    )(*zero)
    J = torch.cat([Jx.reshape(-1, 6 * n), Jd.reshape(-1, n * p)], 1)
    free = torch.cat([problem.free_pose.repeat_interleave(6), torch.ones(n * p, dtype=torch.bool)])
    J = J[:, free] * problem.weight.double().reshape(-1, 1).sqrt()
    inverse = torch.linalg.inv(J.mT @ J)
    out = torch.zeros(len(free), dtype=torch.float64)
    out[free] = inverse.diagonal()
    return out[: 6 * n].reshape(n, 6), out[6 * n :].reshape(n, p)


def test_the_block_inverse_is_that_of_the_whole():
    grid, problem = scene(frames=3)
    pose, depth = full_covariance(problem, grid)
    found = marginals(grid, problem, EXACT)
    got = found.pose.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(got, ALIKE * pose, rtol=1e-3, atol=1e-12)
    expected = DEPTHS_ALIKE**0.5 * depth.sqrt() / problem.inverse_depth
    torch.testing.assert_close(found.relative_depth.double(), expected, rtol=2e-3, atol=1e-12)
    assert float(found.pose[:2].abs().max()) == 0


def turning(
    sideways: float, seed: int = 0, camera: Camera = CAMERA
) -> tuple[SampleGrid, BundleProblem]:
    """Six views that turn by three degrees each and move sideways by so much of the depth."""
    g = torch.Generator().manual_seed(seed)
    grid, n = SampleGrid(camera), 6
    turn = torch.arange(n, dtype=torch.float64) * torch.pi / 60
    step = torch.arange(n, dtype=torch.float64) * sideways
    zero = torch.zeros(n, dtype=torch.float64)
    T = se3_exp(torch.stack([step, zero, zero, zero, turn, zero], 1))
    d = 0.7 + 0.6 * torch.rand(n, grid.size, generator=g)
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    source, target = (torch.tensor([p[k] for p in pairs]) for k in (0, 1))
    pixels = project(camera, grid.rays, relative_motion(T, source, target), d[source]).pixels
    weight = torch.full_like(pixels, 4.0)  # half a pixel
    free = torch.ones(n, dtype=torch.bool)
    free[0] = False
    return grid, BundleProblem(
        T, d, source, target, free, torch.ones_like(free), pixels=pixels, weight=weight
    )


def test_depth_is_open_when_the_camera_only_turns():
    def relative(sideways: float) -> float:
        grid, problem = turning(sideways)
        found = marginals(grid, problem, EXACT)
        assert bool(found.relative_depth.isfinite().all())
        return float(found.depth_deviation.median())

    far, near, none = relative(0.05), relative(0.01), relative(1e-6)
    assert far < 0.1
    assert 3 < near / far < 7  # five times less parallax
    assert none > 10


@pytest.mark.parametrize("sideways", [0.05, 0.02])
def test_noise_spreads_poses_and_depths_as_foretold(sideways):
    grid, truth = turning(sideways)
    foretold = marginals(grid, truth, EXACT)
    poses, depths = [], []
    for seed in range(24):
        g = torch.Generator().manual_seed(seed)
        noise = 0.5 * torch.randn(truth.pixels.shape, generator=g)
        noisy = replace(truth, pixels=truth.pixels + noise)
        found = DenseBundle(grid).solve(noisy, BundleOptions(iterations=8, huber=50.0))
        t, length = found.T_cw[:, :3, 3], truth.T_cw[:, :3, 3].norm()
        scale = float((t * truth.T_cw[:, :3, 3]).sum() / length**2)
        poses.append(of_common_length(found.T_cw, truth))
        depths.append(found.inverse_depth * scale / truth.inverse_depth - 1)
    spread = torch.stack(poses).square().mean(0)[1:]
    # These errors are independent of each other.
    expected = foretold.pose.diagonal(dim1=-2, dim2=-1)[1:] / ALIKE
    ratio = spread.sum(0) / expected.sum(0)
    assert float(ratio[3:].min()) > 0.5
    assert float(ratio[3:].max()) < 2.0
    expected = foretold.relative_depth.square() / DEPTHS_ALIKE
    square = torch.stack(depths).square().mean(0) / expected
    assert 0.6 < float(square.median()) < 1.5


def of_common_length(T: Tensor, truth: BundleProblem) -> Tensor:
    """Errors of poses whose lengths are brought to those of the truth, as covariances are."""
    t, length = T[:, :3, 3], truth.T_cw[:, :3, 3].norm()
    T = T.clone()
    T[:, :3, 3] /= float((t * truth.T_cw[:, :3, 3]).sum() / length**2)
    return se3_log(T @ se3_inverse(truth.T_cw))


def test_errors_in_common_move_poses_and_depths_as_foretold(monkeypatch):
    monkeypatch.setattr(room, "PLACES", (2, 1))
    grid, truth = turning(0.05)
    known = marginals(grid, truth, EXACT)
    found, depths, _ = common_errors(grid, truth, EXACT, known)
    left = (grid.pixels[:, 0] < CAMERA.width / 2).float()
    onward = (truth.target - truth.source).sign()[:, None].float()
    expected, expected_depths = torch.zeros_like(found), torch.zeros_like(depths)
    for part in (left, 1 - left):
        for axis in (0, 1):
            for size in (COMMON_FLOW * onward, torch.full_like(onward, COMMON_PLACE)):
                pixels = truth.pixels.clone()
                pixels[..., axis] += 0.5 * size * part  # half a pixel is one deviation
                solved = DenseBundle(grid).solve(
                    replace(truth, pixels=pixels), BundleOptions(iterations=12, huber=50.0)
                )
                move = of_common_length(solved.T_cw, truth).reshape(-1)
                expected += move[:, None] * move
                t = truth.T_cw[:, :3, 3]
                length = float((solved.T_cw[:, :3, 3] * t).sum() / t.square().sum())
                relative = solved.inverse_depth * length / truth.inverse_depth - 1
                expected_depths += relative.square()
    assert float((depths.sum(1) / expected_depths.sum(1)).log().abs().max()) < 0.1
    both = known.beside(room.Considered(found, depths))
    torch.testing.assert_close(both.relative_depth, (known.relative_depth**2 + depths).sqrt())
    torch.testing.assert_close(both.covariance, known.covariance + found)
    got, wanted = (m.diagonal().reshape(-1, 6)[1:] for m in (found, expected))
    assert float((got.sum(0) / wanted.sum(0)).log().abs().max()) < 0.1
    assert float(found[:6].abs().max()) == 0


def test_cells_do_not_average_what_matches_have_in_common(monkeypatch):
    monkeypatch.setattr(room, "PLACES", (2, 1))
    double = Camera(
        2 * CAMERA.fx, 2 * CAMERA.fy, 2 * CAMERA.cx, 2 * CAMERA.cy,
        2 * CAMERA.width, 2 * CAMERA.height,
    )  # fmt: skip
    variances = []
    for camera in (CAMERA, double):
        grid, problem = turning(0.05, camera=camera)
        known = marginals(grid, problem, EXACT)
        common = common_errors(grid, problem, EXACT, known).covariance
        variances.append([m.diagonal().sum() for m in (known.covariance, common)])
    (own, common), (finer_own, finer_common) = variances
    # Half a pixel is half the angle; there are four times as many cells.
    assert float(own / finer_own) == pytest.approx(16, rel=0.35)
    assert 2.5 < float(common / finer_common) < 7


def test_where_nothing_is_known_errors_in_common_add_nothing():
    grid, problem = turning(0.05)
    known = marginals(grid, problem, EXACT)
    unknown = replace(known, covariance=torch.full_like(known.covariance, torch.inf))
    errors = common_errors(grid, problem, EXACT, unknown)
    assert not errors.covariance.any()
    assert not errors.relative_depth.any()


def test_what_nothing_measures_is_open():
    grid, problem = turning(0.05)
    weight = problem.weight.clone()
    weight[problem.source == 2, 7] = 0
    found = marginals(grid, replace(problem, weight=weight), EXACT)
    assert found.relative_depth[2, 7] == torch.inf
    assert bool(found.relative_depth[2, :7].isfinite().all())
    weight[problem.source == 2] = 0
    assert marginals(grid, replace(problem, weight=weight), EXACT).depth_deviation[2] == torch.inf


def test_bare_walls_leave_what_stands_before_them_known():
    grid, problem = turning(0.05)
    every = marginals(grid, problem, EXACT).depth_deviation

    def seen(tenths: int) -> Marginals:
        weight = problem.weight.clone()
        weight[:, torch.arange(grid.size) % 10 >= tenths] = 0
        return marginals(grid, replace(problem, weight=weight), EXACT)

    found = seen(2)
    assert bool((found.depth_deviation < 5 * every).all())
    rows = [sorted(row.tolist()) for row in found.relative_depth]
    by_hand = [row[math.ceil(0.15 * (len(row) - 1))] for row in rows]
    assert found.depth_deviation.tolist() == pytest.approx(by_hand)
    assert not seen(1).depth_deviation.isfinite().any()


def test_some_cells_stand_for_all():
    grid, problem = turning(0.05)
    every, some = (marginals(grid, problem, EXACT, cells=n) for n in (grid.size, grid.size // 3))
    assert some.relative_depth.shape[1] <= grid.size // 3
    ratio = some.pose[1:].diagonal(dim1=-2, dim2=-1) / every.pose[1:].diagonal(dim1=-2, dim2=-1)
    assert float((ratio.log().abs()).median()) < 0.3
    ratio = some.depth_deviation / every.depth_deviation
    assert float(ratio.log().abs().max()) < 0.2


def test_parts_of_a_large_problem_are_fetched():
    grid, problem = turning(0.05)
    parts = []

    def matches(edges: slice):
        parts.append(edges)
        return problem.pixels[edges], problem.weight[edges]

    streamed = StreamedProblem(
        problem.T_cw, problem.inverse_depth, problem.source, problem.target,
        problem.free_pose, problem.free_depth, matches=matches,
    )  # fmt: skip
    one, other = (marginals(grid, p, replace(EXACT, chunk=7)) for p in (problem, streamed))
    assert len(parts) > 4
    assert torch.equal(one.pose, other.pose)
    assert torch.equal(one.relative_depth, other.relative_depth)


def test_half_of_what_is_said_lies_below_the_weighted_median():
    """Against copies: each value as many times as it weighs."""
    g = torch.Generator().manual_seed(3)
    values, copies = torch.randn(40, generator=g), torch.randint(1, 9, (40,), generator=g)
    expected = values.repeat_interleave(copies).median()  # the lower one of two in the middle
    assert float(weighted_median(values, copies.float())) == pytest.approx(expected.item())
    assert float(weighted_median(values[:1], torch.ones(1))) == pytest.approx(values[0].item())


def test_matches_that_say_nothing_do_not_tell_how_well_others_fit():
    grid, problem = turning(0.1)
    g = torch.Generator().manual_seed(4)
    noise = 0.5 * torch.randn(problem.pixels.shape, generator=g)
    noisy = replace(problem, pixels=problem.pixels + noise)
    whole = marginals(grid, noisy, EXACT).normalised_residual
    assert float(whole.mean()) == pytest.approx(math.sqrt(2 * math.log(2)), rel=0.05)
    is_bare = torch.arange(grid.size) % 3 > 0
    weight = torch.where(is_bare[:, None], 1e-3, 1.0) * noisy.weight
    found = marginals(grid, replace(noisy, weight=weight), EXACT).normalised_residual
    torch.testing.assert_close(found, whole, rtol=0.2, atol=0)


def walk(n: int = 7, spread: float = 1.0) -> torch.Tensor:
    """Poses along a bent path."""
    g = torch.Generator().manual_seed(5)
    xi = torch.randn(n, 6, dtype=torch.float64, generator=g)
    xi[:, :3] *= spread
    return se3_exp(xi)


def covariance(n: int, seed: int = 1) -> torch.Tensor:
    """Of perturbations of a thousandth, correlated between all poses."""
    A = torch.randn(
        6 * n, 6 * n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    return 1e-6 * A @ A.mT / n


def _aligned(centres: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Centres after the similarity that brings them nearest to the true ones."""
    s, R, t = umeyama(torch.from_numpy(centres), torch.from_numpy(truth))
    return (s * torch.from_numpy(centres) @ R.mT + t).numpy()


def test_samples_aligned_one_by_one_spread_as_foretold():
    T, n = walk(), 7
    C = covariance(n)
    found = deviations_after_alignment(T, C)
    xi = np.random.default_rng(2).multivariate_normal(np.zeros(6 * n), C.numpy(), 3000)
    moved = se3_exp(torch.from_numpy(xi).reshape(-1, n, 6)) @ T
    centres, truth = se3_inverse(moved)[..., :3, 3].numpy(), se3_inverse(T)[:, :3, 3].numpy()
    aligned = np.stack([_aligned(c, truth) for c in centres])
    position = np.sqrt(np.square(aligned - truth).sum(-1).mean(0))
    assert found.position.numpy() == pytest.approx(position, rel=0.06)
    R, R_true = se3_inverse(moved)[..., :3, :3].numpy(), se3_inverse(T)[:, :3, :3].numpy()
    angles = np.stack([np.radians(rotation_angle(best_rotation(r, R_true) @ r, R_true)) for r in R])
    assert found.rotation.numpy() == pytest.approx(np.sqrt((angles**2).mean(0)), rel=0.06)


def test_what_a_similarity_does_is_no_error():
    T = walk()
    c = se3_inverse(T)[:, :3, 3]
    # The whole world moved, turned and grown: what each pose's perturbation is then.
    g = torch.randn(7, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    moves = [
        torch.cat([T[:, :3, :3] @ v, torch.zeros(7, 3, dtype=torch.float64)], 1)
        for v in torch.eye(3, dtype=torch.float64)
    ]
    grown = torch.cat([(T[:, :3, :3] @ c[..., None])[..., 0], torch.zeros_like(c)], 1)
    turned = []
    for axis in torch.eye(3, dtype=torch.float64):
        tau = T[:, :3, :3] @ torch.linalg.cross(axis.expand_as(c), c)[..., None]
        turned.append(torch.cat([tau[..., 0], T[:, :3, :3] @ axis], 1))
    J = torch.stack([*moves, *turned, grown]).reshape(7, -1)
    C = covariance(7)
    first = deviations_after_alignment(T, C)
    second = deviations_after_alignment(T, C + 1e-3 * J.mT @ (g @ g.mT) @ J)
    torch.testing.assert_close(second.position, first.position, rtol=1e-6, atol=0)
    assert float(first.position.min()) > 1e-4
    free = deviations_after_alignment(T, J.mT @ J)
    assert float(free.position.max()) < 1e-6
    assert float(free.rotation.max()) < 1e-6


def test_cameras_at_one_place_have_only_their_mean_taken_out():
    found = deviations_after_alignment(walk(spread=0.0), torch.eye(42, dtype=torch.float64))
    assert found.position.numpy() == pytest.approx(np.sqrt(3 * (1 - 1 / 7)), rel=1e-6)
