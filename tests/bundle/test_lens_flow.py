"""The compiled loops over edges seen through a lens against plain PyTorch."""

from dataclasses import replace

import pytest
import torch

from geogs.bundle.lens import LensBlock
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.geometry.camera import Camera
from lens_scene import CAMERA, GRID, disturbed, lens_problem
from lenses import LENSES
from oracles import lens_reference
from oracles.pinhole_flow import PinholeFlow

HUBER = 2.0
OPTIONS = BundleOptions(huber=HUBER, depth_damping=0.0)


def problem_of(lens: Camera) -> BundleProblem:
    """One of whose cells some are behind their targets and some have no match."""
    problem = disturbed(lens_problem(lens, frames=4, noise=0.5), 0.05, 0.1)
    T, d, weight = (x.clone() for x in (problem.T_cw, problem.inverse_depth, problem.weight))
    T[2, 2, 3] -= 2.5
    d[:, ::2] += 1.0  # none is hardly before it
    d[:, 1::2] = 0.1
    weight[1, ::3] = 0
    return replace(problem, T_cw=T, inverse_depth=d, weight=weight)


def close(found: torch.Tensor, wanted: torch.Tensor) -> bool:
    """To rounding, by the size of what is summed."""
    return float((found - wanted).norm() / wanted.norm()) < 2e-5


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("shared", ["lens", "lens and more", "more", "nothing"])
def test_equations_are_those_of_plain_pytorch(name, shared):
    lens = replace(CAMERA, **LENSES[name])
    problem, block = problem_of(lens), LensBlock(lens, GRID.pixels)
    g = torch.Generator().manual_seed(2)
    e, *cells = problem.pixels.shape
    more = torch.randn(e, 2, *cells, generator=g) if "more" in shared else None
    wanted = lens_reference.equations(problem, block, HUBER, more)
    chosen = [n for n in range(wanted.gradient.shape[1]) if n < 6 or n >= 9 or "lens" in shared]
    known = None if "lens" in shared else block
    flow = LensFlow(known, None if more is None else lambda part: more)
    state = BundleState(problem.T_cw, problem.inverse_depth, block)
    sources = list(flow.sources(problem, state, OPTIONS))
    for source, (frame, e) in zip(sources, sources_within(problem.source), strict=True):
        edges, at = source.edges, 6 * (e.stop - e.start)
        assert source.frame == frame
        assert edges.shared == len(chosen) - 6
        H = wanted.hessian[e][:, chosen][:, :, chosen]
        v, E = wanted.gradient[e][:, chosen], wanted.coupling[e][:, chosen]
        assert close(edges.hessian[:at, :at], torch.block_diag(*H[:, :6, :6]))
        assert close(edges.gradient[:at], v[:, :6].flatten())
        assert close(edges.depth.coupling[:at], E[:, :6].flatten(0, 1))
        if edges.shared:
            assert close(edges.hessian[:at, at:], H[:, :6, 6:].flatten(0, 1))
            assert close(edges.hessian[at:, at:], H[:, 6:, 6:].sum(0))
            assert close(edges.gradient[at:], v[:, 6:].sum(0))
            assert close(edges.depth.coupling[at:], E[:, 6:].sum(0))
        assert torch.equal(edges.hessian, edges.hessian.mT)
        assert close(source.edges.depth.information, wanted.curvature[e].sum(0))
        assert close(edges.depth.gradient, wanted.pull[e].sum(0))


@pytest.mark.parametrize("distortion", [(0.0, 0.0), (-0.2, 0.05)])
@pytest.mark.parametrize("huber", [0.3, 30.0])
def test_the_cost_is_that_of_plain_pytorch(distortion, huber):
    lens = CAMERA.moved(0.0, *distortion)
    problem, block = problem_of(lens), LensBlock(lens, GRID.pixels)
    state = BundleState(problem.T_cw, problem.inverse_depth, block)
    found = LensFlow().cost(problem, state, huber)
    assert found == pytest.approx(lens_reference.cost(problem, block, huber), rel=1e-5)


def test_depths_after_a_step_are_those_of_plain_pytorch():
    problem, g = problem_of(CAMERA), torch.Generator().manual_seed(3)
    xi = 0.01 * torch.randn(len(problem.T_cw), 6, generator=g, dtype=torch.float64)
    options = replace(OPTIONS, depth_damping=1e-3)
    sources = LensFlow.of(GRID).sources(problem, problem.start, options)
    plain = PinholeFlow(GRID.camera, GRID.rays).depths_after(problem, problem.start, xi, options)
    for source, (frame, wanted) in zip(sources, plain, strict=True):
        assert source.frame == frame
        found = source.edges.depth_after(xi.reshape(-1), len(xi))
        assert close(found.gradient, wanted.gradient)
        assert close(found.curvature, wanted.curvature)
