"""Dense bundle adjustment against its reference and a known scene."""

from dataclasses import replace

import pytest
import torch

from bundle_scenes import CAMERA, disturbed, scene
from geogs.bundle.dense import DenseBundle
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import linearise, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import DepthDamping, MeasuredDepths
from geogs.geometry.lie import retract, se3_inverse
from oracles.bundle_reference import gauss_newton_step


@pytest.mark.parametrize("huber", [0.5, 50.0])
@pytest.mark.parametrize("chunk", [1, 4, 100])
def test_one_step_matches_dense_normal_equations(huber, chunk):
    grid, problem = scene()
    problem = disturbed(problem, 0.02, 0.05)
    free_depth = problem.free_depth.clone()
    free_depth[1] = False
    problem = replace(problem, free_depth=free_depth)
    options = BundleOptions(iterations=1, huber=huber, chunk=chunk)
    xi, delta = gauss_newton_step(problem, CAMERA, grid.rays, options)
    result = DenseBundle(grid).solve(problem, options)
    assert result.finite
    assert float(xi.abs().max()) > 0.01
    torch.testing.assert_close(result.T_cw, retract(xi, problem.T_cw), rtol=0, atol=2e-5)
    expected = problem.inverse_depth.double() + delta
    torch.testing.assert_close(result.inverse_depth.double(), expected, rtol=0, atol=5e-5)


def test_damping_resists_the_depth_it_is_given_for():
    grid, problem = scene()
    problem = disturbed(problem, 0.02, 0.05)
    damping = torch.zeros_like(problem.inverse_depth)
    damping[1] = 3e3 * torch.rand(grid.size, generator=torch.Generator().manual_seed(2))
    damping[2, 7] = 1e9
    options = BundleOptions(iterations=1, huber=50.0)
    damped = replace(problem, depth_terms=(DepthDamping(damping),))
    xi, delta = gauss_newton_step(damped, CAMERA, grid.rays, options)
    result = DenseBundle(grid).solve(damped, options)
    torch.testing.assert_close(result.T_cw, retract(xi, problem.T_cw), rtol=0, atol=2e-5)
    expected = problem.inverse_depth.double() + delta
    torch.testing.assert_close(result.inverse_depth.double(), expected, rtol=0, atol=5e-5)
    plain = DenseBundle(grid).solve(problem, options)
    moved, freely = ((r.inverse_depth - problem.inverse_depth).abs() for r in (result, plain))
    assert float(moved[2, 7]) < 1e-5 < 1e-3 < float(freely[2, 7])
    assert float(moved[1].mean()) < 0.8 * float(freely[1].mean())


def measured_anew(problem: BundleProblem, seed: int = 3) -> MeasuredDepths:
    """Some cells measured, a few of them far off."""
    g = torch.Generator().manual_seed(seed)
    shape = problem.inverse_depth.shape
    off = 0.02 * torch.randn(shape, generator=g) + 0.5 * (torch.rand(shape, generator=g) < 0.05)
    known = torch.rand(shape, generator=g) < 0.7
    return MeasuredDepths(problem.inverse_depth + off, 2e3 * known)


@pytest.mark.parametrize("huber", [0.5, 50.0])
def test_measured_depths_pull_as_in_the_reference(huber):
    grid, truth = scene()
    problem = replace(disturbed(truth, 0.02, 0.05), depth_terms=(measured_anew(truth),))
    free_depth = problem.free_depth.clone()
    free_depth[1] = False
    problem = replace(problem, free_depth=free_depth)
    options = BundleOptions(iterations=1, huber=huber)
    xi, delta = gauss_newton_step(problem, CAMERA, grid.rays, options)
    result = DenseBundle(grid).solve(problem, options)
    torch.testing.assert_close(result.T_cw, retract(xi, problem.T_cw), rtol=0, atol=2e-5)
    expected = problem.inverse_depth.double() + delta
    torch.testing.assert_close(result.inverse_depth.double(), expected, rtol=0, atol=5e-5)
    plain = DenseBundle(grid).solve(replace(problem, depth_terms=()), options)
    assert float((plain.inverse_depth - result.inverse_depth).abs().max()) > 0.01
    assert float((result.information - plain.information).max()) > 10


def test_measured_depths_say_how_long_a_step_is():
    grid, truth = scene()
    free = torch.ones(len(truth.T_cw), dtype=torch.bool)
    free[0] = False
    start = replace(
        disturbed(replace(truth, free_pose=free), 0.02, 0.05),
        depth_terms=(
            MeasuredDepths(truth.inverse_depth, torch.full_like(truth.inverse_depth, 1e4)),
        ),
    )
    result = DenseBundle(grid).solve(start, BundleOptions(iterations=12, huber=10.0))
    centres = [
        se3_inverse(T)[:, :3, 3] - se3_inverse(T)[0, :3, 3] for T in (result.T_cw, truth.T_cw)
    ]
    assert float((centres[0] - centres[1]).norm(dim=1).max()) < 1e-4


def test_what_was_measured_stays_known_without_matches():
    grid, problem = scene()
    alone = (problem.source != 3) & (problem.target != 3)
    problem = replace(
        problem, source=problem.source[alone], target=problem.target[alone],
        pixels=problem.pixels[alone], weight=problem.weight[alone],
        depth_terms=(measured_anew(problem),),
    )  # fmt: skip
    result = DenseBundle(grid).solve(problem, BundleOptions(iterations=1))
    assert torch.equal(result.information[3], problem.depth_terms[0].information[3])


def test_recovers_a_disturbed_scene():
    grid, truth = scene()
    start = disturbed(truth, 0.03, 0.1)
    result = DenseBundle(grid).solve(start, BundleOptions(iterations=12, huber=10.0))
    centres = se3_inverse(result.T_cw)[:, :3, 3] - se3_inverse(truth.T_cw)[:, :3, 3]
    assert float(centres.norm(dim=1).max()) < 1e-4  # of a scene about 2 units away
    assert float((result.inverse_depth / truth.inverse_depth - 1).abs().max()) < 1e-3
    torch.testing.assert_close(result.T_cw[:2], truth.T_cw[:2], rtol=0, atol=0)


def test_outliers_do_not_pull():
    grid, truth = scene(frames=5)
    g = torch.Generator().manual_seed(3)
    wrong = torch.rand(truth.pixels.shape[:2], generator=g) < 0.1
    pixels = truth.pixels + 8.0 * torch.randn(truth.pixels.shape, generator=g) * wrong[..., None]
    start = disturbed(replace(truth, pixels=pixels), 0.01, 0.03)
    robust = DenseBundle(grid).solve(start, BundleOptions(iterations=30, huber=0.1))
    plain = DenseBundle(grid).solve(start, BundleOptions(iterations=30, huber=1e3))
    error = [float((r.T_cw - truth.T_cw).abs().max()) for r in (robust, plain)]
    assert error[0] < 2e-3
    assert error[0] < 0.1 * error[1]


def test_information_is_the_sum_of_squared_weighted_slopes():
    grid, problem = scene()
    result = DenseBundle(grid).solve(problem, BundleOptions(iterations=1))
    T = relative_motion(problem.T_cw, problem.source, problem.target)
    p = linearise(CAMERA, grid.rays, T, problem.inverse_depth[problem.source])
    per_edge = (problem.weight * p.valid[..., None] * p.depth_jacobian.square()).sum(-1)
    for frame in range(4):
        expected = per_edge[problem.source == frame].sum(0)
        torch.testing.assert_close(result.information[frame], expected, rtol=1e-5, atol=1e-5)


def test_depth_of_a_cell_without_measurements_stays():
    grid, problem = scene()
    weight = problem.weight.clone()
    weight[problem.source == 2, 5] = 0
    problem = disturbed(replace(problem, weight=weight), 0.01, 0.05)
    result = DenseBundle(grid).solve(problem, BundleOptions(iterations=3))
    assert float(result.information[2, 5]) == 0
    torch.testing.assert_close(result.inverse_depth[2, 5], problem.inverse_depth[2, 5])


def test_not_finite_input_is_refused_and_reported():
    grid, problem = scene()
    pixels = problem.pixels.clone()
    pixels[0, 0] = torch.nan
    result = DenseBundle(grid).solve(replace(problem, pixels=pixels), BundleOptions(iterations=2))
    assert not result.finite
    torch.testing.assert_close(result.T_cw, problem.T_cw)
    torch.testing.assert_close(result.inverse_depth, problem.inverse_depth)


def test_same_input_same_result():
    grid, problem = scene()
    problem = disturbed(problem, 0.02, 0.05)
    a, b = (DenseBundle(grid).solve(problem, BundleOptions(iterations=3)) for _ in range(2))
    assert torch.equal(a.T_cw, b.T_cw)
    assert torch.equal(a.inverse_depth, b.inverse_depth)
