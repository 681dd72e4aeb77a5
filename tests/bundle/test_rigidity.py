"""What no depth explains of matches whose poses are known."""

import pytest
import torch

import geogs.bundle.cuda.rigidity as cuda_rigidity
from bundle_scenes import scene
from cuda_emulator import use_emulator
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import INVERSE_DEPTHS, project, relative_motion
from geogs.bundle.rigidity import BEHIND, best_residuals
from geogs.world.grid import SampleGrid

HUBER = 0.5


def residuals(grid: SampleGrid, p: BundleProblem, iterations: int = 12) -> torch.Tensor:
    return best_residuals(
        grid.camera, grid.rays, p.T_cw, p.inverse_depth, p.source, p.target, p.pixels, p.weight,
        HUBER, iterations,
    )  # fmt: skip


def searched(grid: SampleGrid, p: BundleProblem) -> torch.Tensor:
    """The residuals at the best of many depths of each cell, by Huber's cost."""
    T = relative_motion(p.T_cw, p.source, p.target)
    found = torch.zeros(len(p.source), grid.size)
    depths = torch.linspace(0.05, 1.5, 1001)[:, None]
    for frame in p.source.unique().tolist():
        e = p.source == frame
        norms = []
        for edge in torch.nonzero(e)[:, 0].tolist():
            every = depths.expand(-1, grid.size)
            at = project(grid.camera, grid.rays, T[edge].expand(1001, 4, 4), every)
            square = p.weight[edge] * (p.pixels[edge] - at.pixels).square()
            norms.append(square.sum(-1).sqrt())
        norm = torch.stack(norms, 1)
        cost = torch.where(norm > HUBER, 2 * HUBER * norm - HUBER**2, norm.square()).sum(1)
        found[e] = norm.gather(0, cost.argmin(0)[None, None].expand(1, int(e.sum()), -1))[0]
    return found


def test_matches_of_a_rigid_scene_leave_nothing_whatever_the_depth_was():
    grid, problem = scene()
    problem.inverse_depth[:] = 0.55
    assert float(residuals(grid, problem).max()) < 0.02


def test_what_is_left_of_contradicting_matches_is_what_a_search_over_depths_leaves():
    grid, problem = scene(seed=3)
    g = torch.Generator().manual_seed(5)
    problem.pixels.add_(1.5 * torch.randn(problem.pixels.shape, generator=g))
    found, expected = residuals(grid, problem, 60), searched(grid, problem)
    # Few cells have two minima, or their best depth beyond the search.
    alike = (found - expected).abs() < 0.03 + 0.03 * expected
    assert float(alike.float().mean()) > 0.95
    assert float(found.mean()) == pytest.approx(float(expected.mean()), rel=0.02)


def test_unmatched_cells_have_no_residual_and_points_behind_a_large_one():
    grid, problem = scene()
    problem.weight[0, :7] = 0
    left = residuals(grid, problem)
    assert float(left[0, :7].abs().max()) == 0
    turned = problem.T_cw.clone()
    turned[1, :3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double() @ turned[1, :3, :3]
    T, d = turned, problem.inverse_depth
    left = best_residuals(
        grid.camera, grid.rays, T, d, problem.source[:1], torch.tensor([1]), problem.pixels[:1],
        problem.weight[:1],
    )  # fmt: skip
    assert float(left[0, 7:].min()) > 10
    assert INVERSE_DEPTHS[0] < 0.05


@pytest.mark.parametrize("place", ["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def test_the_kernel_leaves_what_pytorch_leaves(place, monkeypatch):
    device = torch.device("cuda" if place == "gpu" else "cpu")
    if place == "emulated":
        use_emulator(monkeypatch, cuda_rigidity)
    elif not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    grid, p = scene(seed=3)
    g = torch.Generator().manual_seed(5)
    p.pixels.add_(1.5 * torch.randn(p.pixels.shape, generator=g))
    p.weight[0, :7] = 0
    p.T_cw[2, 2, 3] -= 3.0  # some of what it shows is behind the others
    expected = residuals(grid, p, 3)
    assert int((expected == BEHIND).sum()) > 20
    turned = torch.randperm(len(p.source), generator=g)  # the edges may come in any order
    T_ji = relative_motion(p.T_cw, p.source, p.target)[turned]
    found = cuda_rigidity.best_residuals(
        grid.camera, grid.rays.to(device), T_ji, p.inverse_depth.to(device), p.source[turned],
        p.pixels[turned].to(device), p.weight[turned].to(device), HUBER, 3, INVERSE_DEPTHS, BEHIND,
    ).cpu()  # fmt: skip
    off = (found - expected[turned]).abs() > 1e-3 + 1e-3 * expected[turned]
    assert float(off.float().mean()) < 0.002  # on the verge of lying behind
