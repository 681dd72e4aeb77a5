"""Alignment of priors, and joint depth and scale adjustment against its reference."""

from dataclasses import replace

import pytest
import torch

from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import project, relative_motion
from geogs.config import PriorConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.priors.monocular_prior import DepthKind, align_inverse_depth
from geogs.tracking.depth_prior import (
    DEVIATION,
    FlowEvidence,
    adjust_depth,
    depth_scale_step,
    flow_evidence,
    local_deviation,
    mean_around,
    node_differences,
    node_weights,
)
from geogs.world.grid import SampleGrid
from oracles.depth_prior_reference import joint_step, residuals, scale_field

CAMERA = Camera(fx=70.0, fy=72.0, cx=39.0, cy=29.0, width=80, height=60)
HUBER = 0.5
TWO = PriorConfig(scale_rows=2, scale_columns=2, scale_step=1e3)
"""HI-SLAM2's scales."""


def scene(seed: int = 0) -> tuple[SampleGrid, BundleProblem]:
    """Exact flow between three views of smooth depth; matches of a patch of the first are gone."""
    g = torch.Generator().manual_seed(seed)
    grid = SampleGrid(CAMERA)
    steps = 0.1 * torch.randn(3, 6, generator=g, dtype=torch.float64)
    T = se3_exp(steps * torch.tensor([1, 1, 1, 0.3, 0.3, 0.3], dtype=torch.float64))
    x, y = grid.pixels.unbind(-1)
    d = torch.stack([0.5 + 0.006 * x + 0.1 * torch.sin(0.05 * y + k) for k in range(3)])
    source, target = torch.tensor([0, 0, 1, 1, 2, 2]), torch.tensor([1, 2, 0, 2, 0, 1])
    pixels = project(CAMERA, grid.rays, relative_motion(T, source, target), d[source]).pixels
    weight = 4 + 40 * torch.rand(6, grid.size, 2, generator=g)
    bare = (x > 20) & (x < 52) & (y > 10) & (y < 40)
    weight[:2, bare] = 0
    fixed = torch.zeros(3, dtype=torch.bool)
    return grid, BundleProblem(T, d, source, target, fixed, ~fixed, pixels=pixels, weight=weight)


def disturbed(problem: BundleProblem, amount: float, seed: int = 1) -> BundleProblem:
    g = torch.Generator().manual_seed(seed)
    noise = 1 + amount * torch.randn(problem.inverse_depth.shape, generator=g)
    return replace(problem, inverse_depth=problem.inverse_depth * noise)


def prior_of(grid: SampleGrid, d: torch.Tensor, scale: list[float]) -> torch.Tensor:
    """The prior that is right with these scales at the corners."""
    return d / scale_field(grid, torch.tensor(scale).reshape(2, 2))


@pytest.mark.parametrize(("rows", "columns", "step"), [(2, 2, None), (3, 4, 0.1)])
def test_step_equals_the_dense_normal_equations(rows: int, columns: int, step: float | None):
    grid, exact = scene()
    p = disturbed(exact, 0.03)
    prior = torch.stack([prior_of(grid, d, [1.2, 0.9, 1.1, 1.0]) for d in exact.inverse_depth])
    prior = prior * (1 + 0.05 * torch.sin(grid.pixels[:, 0] * 0.3))
    prior[:, ::7] = 0
    g = torch.Generator().manual_seed(5)
    scale = 2 + 0.2 * torch.rand(3, rows * columns, generator=g)
    alpha = torch.where(prior > 0, 1 / (0.05 * prior) ** 2, 0.0)
    stiffness = node_differences(rows, columns).double() / (step or torch.inf) ** 2
    flow = flow_evidence(grid, p, HUBER)
    basis = node_weights(grid, rows, columns)
    depths, scale_steps = depth_scale_step(
        flow, p.inverse_depth, prior, scale, alpha, basis, stiffness
    )
    for n in range(3):
        nodes = scale[n].reshape(rows, columns)
        depth, scales = joint_step(grid, p, n, prior[n], nodes, alpha[n], HUBER, step or torch.inf)
        torch.testing.assert_close(
            scale_steps[n].double(), scales.reshape(-1), rtol=2e-3, atol=1e-4
        )
        torch.testing.assert_close(depths[n].double(), depth, rtol=2e-3, atol=5e-5)
        assert float(depth.abs().max()) > 0.02
        assert float(scales.abs().max()) > 0.5


def test_the_scale_is_bilinear_between_nodes():
    grid = SampleGrid(CAMERA)
    scale = torch.tensor([[1.0, 2.0, 4.0], [3.0, 5.0, 9.0]])
    field = node_weights(grid, 2, 3) @ scale.reshape(-1)
    torch.testing.assert_close(field, scale_field(grid, scale))
    shaped = field.reshape(grid.height, grid.width)
    assert shaped[[0, 0, -1, -1], [0, -1, 0, -1]].tolist() == [1, 4, 3, 9]
    assert float(scale.reshape(-1) @ node_differences(2, 3) @ scale.reshape(-1)) == pytest.approx(
        1 + 4 + 4 + 16 + 4 + 9 + 25
    )


def test_repeated_steps_end_where_the_cost_is_least():
    """At the end the cost's finite differences vanish along every scale and some depths."""
    grid, exact = scene()
    p = disturbed(exact, 0.02)
    prior = prior_of(grid, exact.inverse_depth[0], [1.1, 0.9, 1.0, 1.05])
    prior = prior * (1 + 0.04 * torch.sin(grid.pixels[:, 1] * 0.4))
    alpha = 1 / (0.05 * prior) ** 2
    problem = replace(
        p, source=p.source[:2], target=p.target[:2], pixels=p.pixels[:2], weight=p.weight[:2],
    )  # fmt: skip
    scale = torch.ones(1, 4)
    basis, none, huge = node_weights(grid, 2, 2), torch.zeros(4, 4, dtype=torch.float64), 1e6
    for _ in range(6):
        flow = flow_evidence(grid, problem, huge)
        flow = FlowEvidence(flow.curvature[:1], flow.gradient[:1])
        d = problem.inverse_depth[:1]
        step, scale_step = depth_scale_step(flow, d, prior[None], scale, alpha[None], basis, none)
        scale = scale + scale_step
        moved = problem.inverse_depth.clone()
        moved[0] += step[0]
        problem = replace(problem, inverse_depth=moved)

    def cost(depth: torch.Tensor, s: torch.Tensor) -> float:
        flow, rest = residuals(grid, problem, 0, prior.double(), depth, s.reshape(2, 2))
        weighted = (problem.weight[:2].double() * flow**2).sum() + (alpha.double() * rest**2).sum()
        return float(weighted)

    d, s = problem.inverse_depth[0].double(), scale[0].double()
    least = cost(d, s)
    assert least > 1.0  # flow and prior contradict each other, so the optimum is no triviality
    for k in range(4):
        e = 1e-4 * torch.eye(4, dtype=torch.float64)[k]
        slope, bend = cost(d, s + e) - cost(d, s - e), cost(d, s + e) + cost(d, s - e) - 2 * least
        assert abs(slope) / bend < 0.3  # less than 0.15 e from the least
    for u in (0, 17, 33, 58):
        e = torch.zeros_like(d)
        e[u] = 1e-4
        slope, bend = cost(d + e, s) - cost(d - e, s), cost(d + e, s) + cost(d - e, s) - 2 * least
        assert abs(slope) / bend < 0.3


def test_bare_cells_take_the_priors_shape_and_the_matches_scale():
    grid, exact = scene()
    truth = exact.inverse_depth
    flat = torch.where(exact.weight[0, :, 0] > 0, truth[0], truth[0].mean())
    p = replace(exact, inverse_depth=torch.stack([flat, truth[1], truth[2]]))
    prior = torch.stack([prior_of(grid, d, [1.3, 0.8, 1.1, 1.0]) for d in truth])
    adjusted = adjust_depth(
        grid, flow_evidence(grid, p, HUBER), p.inverse_depth, prior, torch.ones(3, 4), TWO
    )
    bare = exact.weight[0, :, 0] == 0
    before = (flat / truth[0] - 1).abs()[bare].mean()
    after = (adjusted.inverse_depth[0] / truth[0] - 1).abs()
    assert float(before) > 0.04
    assert float(after[bare].max()) < 0.01
    assert float(after[~bare].max()) < 0.005
    expected = torch.tensor([1.3, 0.8, 1.1, 1.0]).expand(3, -1)
    torch.testing.assert_close(adjusted.scale, expected, rtol=0.01, atol=0.01)


def test_a_prior_that_contradicts_the_matches_changes_nothing():
    grid, exact = scene()
    g = torch.Generator().manual_seed(3)
    nonsense = exact.inverse_depth * torch.exp(0.8 * torch.randn(3, grid.size, generator=g))
    flow = flow_evidence(grid, exact, HUBER)
    adjusted = adjust_depth(grid, flow, exact.inverse_depth, nonsense, torch.ones(3, 4), TWO)
    assert float(adjusted.information.max()) == 0
    assert torch.equal(adjusted.inverse_depth, exact.inverse_depth)


def test_a_prior_that_is_wrong_in_places_is_not_used_there():
    grid, exact = scene()
    prior = exact.inverse_depth.clone()
    wrong = grid.pixels[:, 0] > 70
    prior[:, wrong] *= 2.5
    flow = flow_evidence(grid, exact, HUBER)
    adjusted = adjust_depth(grid, flow, exact.inverse_depth, prior, torch.ones(3, 4), TWO)
    error = (adjusted.inverse_depth / exact.inverse_depth - 1).abs()
    assert float(error.max()) < 0.05
    right = grid.pixels[:, 0] < 30
    usual = 1 / (DEVIATION * exact.inverse_depth) ** 2
    assert float((adjusted.information / usual)[:, wrong].max()) < 0.05
    assert float((adjusted.information / usual)[:, right].mean()) > 0.3


def test_without_rejection_every_prior_counts_everywhere_alike():
    """JDSA itself: the step of the dense normal equations with one weight, whatever contradicts."""
    grid, exact = scene()
    p = disturbed(exact, 0.02)
    prior = torch.stack([prior_of(grid, d, [1.1, 0.9, 1.0, 1.05]) for d in exact.inverse_depth])
    wrong = grid.pixels[:, 0] > 50
    prior[:, wrong] *= 1.6
    prior[:, ::7] = 0
    scale = torch.ones(3, 4)
    flow = flow_evidence(grid, p, HUBER)
    believed = replace(TWO, reject=False)
    adjusted = adjust_depth(grid, flow, p.inverse_depth, prior, scale, believed)
    alpha = torch.where(prior > 0, 1 / (DEVIATION * prior) ** 2, 0.0)
    torch.testing.assert_close(adjusted.information, alpha)
    for n in range(3):
        depth, scales = joint_step(grid, p, n, prior[n], scale[n].reshape(2, 2), alpha[n], HUBER)
        moved = (adjusted.inverse_depth[n] - p.inverse_depth[n]).double()
        known = prior[n] > 0
        torch.testing.assert_close(moved[known], depth[known], rtol=2e-3, atol=5e-5)
        torch.testing.assert_close(
            (adjusted.scale[n] - 1).double(), scales.reshape(-1), rtol=2e-3, atol=1e-4
        )
    rejecting = adjust_depth(grid, flow, p.inverse_depth, prior, scale, TWO)
    assert float((rejecting.information / alpha)[:, wrong & (prior[0] > 0)].max()) < 0.2
    bare = exact.weight[0, :, 0] == 0
    error = [(a.inverse_depth[0] / exact.inverse_depth[0] - 1).abs() for a in (adjusted, rejecting)]
    assert float(error[0][bare].max()) > 2 * float(error[1][bare].max())


def test_deviation_is_that_of_the_cells_around():
    grid = SampleGrid(Camera(100.0, 100.0, 159.5, 119.5, 320, 240))
    x = grid.pixels[:, 0]
    error = torch.where(x < 100, 0.02, 0.2)[None]
    sure = ((x < 100) | (x > 200)).float()[None]
    deviation = local_deviation(grid, error, sure)[0]
    assert float(deviation[x < 60].max()) < 0.1
    assert 0.17 < float(deviation[x > 280].min()) <= float(deviation.max()) < 0.2
    assert float(deviation[(x > 140) & (x < 160)].mean()) > 0.05
    nothing = local_deviation(grid, error, torch.zeros_like(sure))
    torch.testing.assert_close(nothing, torch.full_like(nothing, 0.05))


@pytest.mark.parametrize("kind", list(DepthKind))
def test_alignment_undoes_what_the_kind_allows(kind: DepthKind):
    g = torch.Generator().manual_seed(0)
    depth = 1 + 4 * torch.rand(800, generator=g)
    values = {
        DepthKind.METRIC: 3.0 * depth,
        DepthKind.SCALE_FREE: 0.1 * depth,
        DepthKind.AFFINE_DEPTH: 2.0 * depth - 1.5,
        DepthKind.AFFINE_INVERSE: 40.0 / depth + 7.0,
    }[kind]
    tracker = 1 / depth * (1 + 0.01 * torch.randn(800, generator=g))
    tracker[:160] *= 3  # a fifth of the tracker's depths are wrong
    weight = torch.ones(800)
    weight[-100:] = 0
    tracker[-100:] = 1.0
    aligned = align_inverse_depth(values, kind, tracker, weight)
    assert aligned is not None
    assert float((aligned * depth - 1).abs().max()) < 0.03


def test_alignment_refuses_what_cannot_be_aligned():
    depth = torch.linspace(1, 5, 400)
    one = torch.ones(400)
    inverse = DepthKind.AFFINE_INVERSE
    assert align_inverse_depth(depth, inverse, 1 / depth, one) is None  # near is far
    assert align_inverse_depth(torch.full_like(depth, 2.0), inverse, 1 / depth, one) is None
    few = torch.zeros(400)
    few[:10] = 1
    assert align_inverse_depth(depth, DepthKind.METRIC, 1 / depth, few) is None
    holes = torch.where(depth < 2, torch.nan, depth)
    aligned = align_inverse_depth(holes, DepthKind.METRIC, 2 / depth, one)
    assert aligned is not None
    assert bool((aligned[depth < 2] == 0).all())
    torch.testing.assert_close(aligned[depth >= 2], (2 / depth)[depth >= 2])


def test_means_are_those_of_windows_cut_at_the_border():
    g = torch.Generator().manual_seed(0)
    field = torch.rand(2, 9, 7, generator=g)
    pooled = torch.nn.functional.avg_pool2d(field[:, None], 5, 1, 2, count_include_pad=False)
    torch.testing.assert_close(mean_around(field, 2.2).float(), pooled[:, 0])
    torch.testing.assert_close(
        mean_around(field, 40.0), field.double().mean((1, 2), keepdim=True).expand(2, 9, 7)
    )
