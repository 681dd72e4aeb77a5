"""Levenberg and Marquardt's steps of an adjustment: what they lower, what they are damped by."""

from dataclasses import dataclass, replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

import geogs.bundle.cuda.dense as cuda_dense
import geogs.bundle.cuda.streamed as cuda_streamed
from bundle_scenes import CAMERA, disturbed, on, scene, streamed
from cuda_emulator import use_emulator
from geogs.bundle.dense import DenseBundle, DenseSchur
from geogs.bundle.hyper_edge import HyperEdge
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.streamed import StreamedBundle, StreamedSchur
from geogs.bundle.terms import BundleState, DepthDamping, MeasuredDepths, MeasuredMotions
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.world.grid import SampleGrid
from oracles.bundle_reference import robust_cost

HUBER = 0.5
LEVENBERG = BundleOptions(iterations=12, huber=HUBER, damping=1e-4, least_damping=1e-8)


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch) -> torch.device:
    """Where the kernels run; everything is emulated where there is no GPU."""
    if request.param == "emulated":
        use_emulator(monkeypatch, cuda_dense, cuda_streamed)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    return torch.device("cuda")


def told(pose: float = 0.02, depth: float = 0.05) -> tuple[SampleGrid, BundleProblem]:
    """A disturbed scene of which depths and motions were measured, too, and not all is matched."""
    grid, truth = scene()
    g = torch.Generator().manual_seed(3)
    d = truth.inverse_depth
    off = 0.02 * torch.randn(d.shape, generator=g) + 0.5 * (torch.rand(d.shape, generator=g) < 0.05)
    at = torch.arange(len(truth.T_cw) - 1)
    wrong = se3_exp(0.02 * torch.randn(len(at), 6, generator=g, dtype=torch.float64))
    motions = MeasuredMotions(
        at, at + 1, wrong @ truth.T_cw[1:] @ se3_inverse(truth.T_cw[:-1]),
        torch.tensor([1e4] * 3 + [1e5] * 3, dtype=torch.float64).expand(len(at), 6),
    )  # fmt: skip
    start = disturbed(truth, pose, depth)
    return grid, replace(
        start,
        weight=start.weight * (torch.rand(start.weight.shape[:2], generator=g) > 0.2)[..., None],
        depth_terms=(DepthDamping(torch.ones_like(d)), MeasuredDepths(d + off, 2e3 * (off < 0.1))),
        pose_terms=(motions,),
    )


def costs(grid: SampleGrid, problem: BundleProblem, device: torch.device) -> dict[str, float]:
    """What each solver takes for the cost at the start."""
    options = replace(LEVENBERG, chunk=5)
    bundle = cuda_dense.CudaDenseBundle(SampleGrid(grid.camera, device))
    there = on(problem, device)
    steps = cuda_dense._DenseSteps(bundle, there, options)
    many = cuda_streamed.CudaStreamedBundle(SampleGrid(grid.camera, device))
    flow = LensFlow.of(grid)
    state = problem.start
    return {
        "dense": DenseSchur(problem, flow, options).cost(state),
        "streamed": StreamedSchur(streamed(problem), grid, options).cost(state),
        "dense, GPU": steps.cost(cuda_dense._State.at_start(there), True),
        "streamed, GPU": cuda_streamed._CudaStreamedSchur(streamed(there), many, options).cost(
            BundleState(state.T_cw, there.inverse_depth)
        ),
    }


@pytest.mark.parametrize("behind", [False, True])
def test_cost_is_that_of_the_reference(behind, device, monkeypatch):
    monkeypatch.setattr(cuda_streamed, "EDGES_TOGETHER", 5)
    grid, problem = told()
    if behind:
        T = problem.T_cw.clone()
        T[2, 2, 3] -= 2.0  # depths are 1.4 to 2.5
        problem = replace(problem, T_cw=T, depth_terms=(), pose_terms=())
    expected = robust_cost(problem, CAMERA, grid.rays, HUBER)
    for name, found in costs(grid, problem, device).items():
        assert found == pytest.approx(expected, rel=2e-4), name


def test_cost_falls_as_the_equations_say():
    """Along a step s the cost changes by -2 g s, g being the right-hand sides."""
    grid, problem = told(0.01, 0.02)
    schur = DenseSchur(problem, LensFlow.of(grid), LEVENBERG)
    state, small = problem.start, 2e-3
    linear = schur.linearise(state)
    step = schur.step(state, linear, 1e-4)
    assert step is not None
    found, d = step.state, problem.inverse_depth

    def at(share: float) -> BundleState:
        xi = share * schur.solve_cameras(linear, 1e-4).reshape(-1, 6)
        T = se3_exp(xi) @ problem.T_cw
        return BundleState(T, d + share * (found.inverse_depth - d))

    measured = (schur.cost(at(small)) - schur.cost(at(-small))) / (2 * small)
    xi = schur.solve_cameras(linear, 1e-4)
    foretold = 0.0
    for source in linear.sources:
        frame, depth = source.frame, source.edges.depth
        # The equations of all else were reduced by those of the depths: b is added again.
        reduced = (depth.coupling @ (depth.gradient / depth.curvature)).double()
        own = replace(source.edges, gradient=source.edges.gradient + reduced)
        foretold += float(own.chained()[1] @ xi[own.rows(len(problem.T_cw))])
        foretold += float(depth.gradient @ (found.inverse_depth - d)[frame])
    for term in problem.pose_terms:
        for edge in term.hyper_edges(state):
            foretold += float(edge.chained()[1] @ xi[edge.rows(len(problem.T_cw))])
    assert measured == pytest.approx(-2 * foretold, rel=0.02)


def solvers(grid: SampleGrid, problem: BundleProblem, device: torch.device):
    """Each solver's way to solve the problem, by its name."""
    there, elsewhere = on(problem, device), SampleGrid(grid.camera, device)
    return {
        "dense": lambda o: DenseBundle(grid).solve(problem, o),
        "streamed": lambda o: StreamedBundle(grid).solve(streamed(problem), o),
        "dense, GPU": lambda o: cuda_dense.CudaDenseBundle(elsewhere).solve(there, o),
        "streamed, GPU": lambda o: cuda_streamed.CudaStreamedBundle(elsewhere).solve(
            streamed(there), o
        ),
    }


def cost_of(grid: SampleGrid, problem: BundleProblem, T: Tensor, d: Tensor) -> float:
    moved = replace(problem, T_cw=T, inverse_depth=d.cpu())
    return DenseSchur(moved, LensFlow.of(grid), LEVENBERG).cost(moved.start)


def test_steps_from_afar_never_raise_the_cost(device):
    """Three cells that are matched leave plain steps much to go astray by."""
    grid, problem = told(1.0, 0.3)
    some = torch.randperm(grid.size, generator=torch.Generator().manual_seed(0))[:3]
    weight = torch.zeros_like(problem.weight)
    weight[:, some] = problem.weight[:, some]
    problem = replace(problem, weight=weight, depth_terms=(), pose_terms=())

    def after(solve, iterations: int, least_damping: float | None = 1e-8) -> float:
        options = replace(LEVENBERG, iterations=iterations, least_damping=least_damping)
        found = solve(options)
        assert found.finite
        return cost_of(grid, problem, found.T_cw, found.inverse_depth)

    before = cost_of(grid, problem, problem.T_cw, problem.inverse_depth)
    for name, solve in solvers(grid, problem, device).items():
        assert after(solve, 2, least_damping=None) > 1.5 * after(solve, 1, least_damping=None), name
        found = [before, *(after(solve, n) for n in (1, 2, 3, 6))]
        assert all(b <= a * (1 + 1e-5) for a, b in pairwise(found)), name
        assert found[-1] < 0.5 * before, name


def test_all_solvers_come_to_the_same(device):
    grid, problem = told()
    found = {name: solve(LEVENBERG) for name, solve in solvers(grid, problem, device).items()}
    first = found.pop("dense")
    assert cost_of(grid, problem, first.T_cw, first.inverse_depth) < 0.5 * cost_of(
        grid, problem, problem.T_cw, problem.inverse_depth
    )
    for result in found.values():
        torch.testing.assert_close(result.T_cw, first.T_cw, rtol=0, atol=3e-4)
        torch.testing.assert_close(
            result.inverse_depth.cpu(), first.inverse_depth, rtol=0, atol=3e-3
        )


@dataclass(frozen=True)
class Indefinite:
    """A term of poses that takes away from the curvature: their equations are not definite."""

    source: Tensor
    less: float

    @property
    def target(self) -> Tensor:
        return self.source

    def hyper_edges(self, state: BundleState) -> list[HyperEdge]:
        H = -self.less * torch.eye(6, dtype=torch.float64)
        return [HyperEdge(frame[None], H, torch.zeros_like(H[0])) for frame in self.source]

    def cost(self, state: BundleState) -> float:
        return 0.0


def test_what_has_no_solution_is_damped_until_it_has(device):
    grid, truth = scene()
    problem = disturbed(truth, 0.02, 0.05)
    schur = DenseSchur(problem, LensFlow.of(grid), LEVENBERG)
    size = float(schur.linearise(problem.start).system.hessian.diagonal().max())
    problem = replace(problem, pose_terms=(Indefinite(torch.tensor([2, 3]), 3e-3 * size),))
    before = cost_of(grid, problem, problem.T_cw, problem.inverse_depth)
    for name, solve in solvers(grid, problem, device).items():
        assert not solve(replace(LEVENBERG, damping=1e-6, least_damping=None)).finite, name
        found = solve(replace(LEVENBERG, damping=1e-6))
        assert found.finite, name
        assert cost_of(grid, problem, found.T_cw, found.inverse_depth) < 0.5 * before, name


def test_what_has_no_solution_at_all_is_refused(device):
    grid, problem = told()
    pixels = problem.pixels.clone()
    pixels[0, 0] = torch.nan
    weight = problem.weight.clone()
    weight[0, 0] = 1.0
    problem = replace(problem, pixels=pixels, weight=weight)
    for name, solve in solvers(grid, problem, device).items():
        found = solve(LEVENBERG)
        assert not found.finite, name
        assert torch.equal(found.T_cw, problem.T_cw), name
        assert torch.equal(found.inverse_depth.cpu(), problem.inverse_depth), name
