"""New kinds of measurements: each is one class, here, and enters a problem by one line."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

import geogs.bundle.cuda.dense as cuda_dense
from bundle_scenes import disturbed, scene
from cuda_emulator import use_emulator
from geogs.bundle.dense import DenseBundle
from geogs.bundle.depth_terms import DepthDamping, MeasuredDepths
from geogs.bundle.hyper_edge import DepthEquations, HyperEdge
from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.streamed import StreamedBundle
from geogs.bundle.terms import BundleState
from geogs.geometry.lie import se3_inverse

BOTH = DenseBundle, cuda_dense.CudaDenseBundle
OPTIONS = BundleOptions(iterations=12, huber=10.0)


@dataclass(frozen=True)
class Positions:
    """Where cameras are in the world, by something like satellites: a term of poses alone."""

    source: Tensor
    """Frames."""
    centre: Tensor
    weight: float

    @property
    def target(self) -> Tensor:
        """It joins each frame with none but itself."""
        return self.source

    def hyper_edges(self, state: BundleState) -> list[HyperEdge]:
        """A step of a pose moves its centre by -R^T tau."""
        found = []
        for frame, measured in zip(self.source, self.centre, strict=True):
            T = state.T_cw[frame]
            J = torch.cat([-T[:3, :3].mT, torch.zeros(3, 3, dtype=T.dtype)], 1)
            error = se3_inverse(T)[:3, 3] - measured
            H, g = self.weight * J.mT @ J, -self.weight * J.mT @ error
            found.append(HyperEdge(frame[None], H, g))
        return found

    def cost(self, state: BundleState) -> float:
        """Weighted squares of what the centres are off by."""
        centre = se3_inverse(state.T_cw[self.source])[:, :3, 3]
        return self.weight * float((centre - self.centre).square().sum())


@dataclass(frozen=True)
class Scales:
    """One scale for each keyframe: a block of unknowns."""

    values: Tensor
    largest_step: float = 0.5

    @property
    def free(self) -> tuple[bool, ...]:
        """All are variables."""
        return (True,) * len(self.values)

    def moved(self, step: Tensor) -> "Scales":
        """After a step."""
        return replace(self, values=self.values + step)


@dataclass(frozen=True)
class ScaledPrior:
    """A prior of inverse depths up to one scale for each keyframe: d = s d_prior."""

    inverse_depth: Tensor
    weight: float
    information: None = None

    def of_frame(self, frame: int, state: BundleState) -> HyperEdge:
        """The residual d - s d_prior joins the frame's depths with its scale."""
        assert isinstance(state.block, Scales)
        prior, shared = self.inverse_depth[frame], len(state.block.values)
        error = state.inverse_depth[frame] - state.block.values[frame].float() * prior
        H, g = torch.zeros(shared, shared).double(), torch.zeros(shared).double()
        H[frame, frame] = self.weight * prior.square().sum()
        g[frame] = self.weight * (prior * error).sum()
        coupling = torch.zeros(shared, len(prior))
        coupling[frame] = -self.weight * prior
        known = torch.full_like(prior, self.weight)
        depth = DepthEquations(coupling, known, -known * error, known)
        return HyperEdge(torch.zeros(0, dtype=torch.long), H, g, shared, depth)

    def cost(self, state: BundleState) -> float:
        """Weighted squares of d - s d_prior."""
        assert isinstance(state.block, Scales)
        error = state.inverse_depth - state.block.values[:, None].float() * self.inverse_depth
        return self.weight * float(error.square().sum())


def streamed(p: BundleProblem) -> StreamedProblem:
    return StreamedProblem(
        p.T_cw, p.inverse_depth, p.source, p.target, p.free_pose, p.free_depth, p.depth_terms,
        p.pose_terms, matches=lambda e: (p.pixels[e], p.weight[e]),
    )  # fmt: skip


def located(frames: int = 4) -> tuple:
    """A scene whose scale only positions tell, from a disturbed start."""
    grid, truth = scene(frames)
    free = torch.ones(len(truth.T_cw), dtype=torch.bool)
    free[0] = False
    centres = se3_inverse(truth.T_cw)[:, :3, 3]
    positions = Positions(torch.arange(1, len(centres)), centres[1:], 1e6)
    start = disturbed(replace(truth, free_pose=free), 0.02, 0.05)
    return grid, start, positions, centres


@pytest.mark.parametrize("solver", [DenseBundle, StreamedBundle])
def test_a_term_of_poses_decides_what_matches_leave_open(solver):
    grid, start, positions, centres = located()
    error = {}
    for name, terms in (("with", (positions,)), ("without", ())):
        problem = replace(start, pose_terms=terms)
        given = streamed(problem) if solver is StreamedBundle else problem
        result = solver(grid).solve(given, OPTIONS)
        assert result.finite
        found = se3_inverse(result.T_cw)[:, :3, 3]
        error[name] = float((found - centres).norm(dim=1).max())
    assert error["with"] < 1e-4
    assert error["without"] > 10 * error["with"]


def test_a_term_of_poses_counts_on_the_gpu_as_on_the_cpu(monkeypatch):
    use_emulator(monkeypatch, cuda_dense)
    grid, start, positions, _ = located()
    problem, options = replace(start, pose_terms=(positions,)), BundleOptions(2, huber=0.5)
    slow, fast = (
        s(grid).solve(problem, options) for s in (DenseBundle, cuda_dense.CudaDenseBundle)
    )
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=3e-5)


def test_a_term_of_depths_that_no_kernel_knows_counts_on_the_gpu(monkeypatch):
    use_emulator(monkeypatch, cuda_dense)
    grid, truth = scene()
    start = disturbed(truth, 0.02, 0.05)
    measured = MeasuredDepths(truth.inverse_depth, torch.full_like(truth.inverse_depth, 2e3))
    doubled = replace(measured, inverse_depth=truth.inverse_depth + 0.02)
    # Of each kind the kernel takes one; the second goes the way of any other term.
    problem = replace(start, depth_terms=(measured, doubled))
    options = BundleOptions(2, huber=0.5)
    slow, fast = (
        s(grid).solve(problem, options) for s in (DenseBundle, cuda_dense.CudaDenseBundle)
    )
    once = DenseBundle(grid).solve(replace(start, depth_terms=(measured,)), options)
    assert float((once.inverse_depth - slow.inverse_depth).abs().max()) > 1e-3
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=3e-5)
    torch.testing.assert_close(fast.inverse_depth, slow.inverse_depth, rtol=3e-4, atol=3e-5)
    torch.testing.assert_close(fast.information, slow.information, rtol=2e-3, atol=5e-2)


def test_a_scale_for_each_keyframe_is_found_along_with_poses_and_depths():
    grid, truth = scene()
    true = torch.tensor([0.8, 1.1, 1.25, 0.9], dtype=torch.float64)
    prior = ScaledPrior(truth.inverse_depth / true[:, None].float(), 100.0)
    start = replace(
        disturbed(truth, 0.02, 0.05),
        depth_terms=(DepthDamping(torch.ones_like(truth.inverse_depth)), prior),
        block=Scales(torch.ones(4, dtype=torch.float64)),
    )
    result = DenseBundle(grid).solve(start, OPTIONS)
    assert result.finite
    assert isinstance(result.block, Scales)
    torch.testing.assert_close(result.block.values, true, rtol=1e-3, atol=0)
    assert float((result.T_cw - truth.T_cw).abs().max()) < 1e-4
    assert float((result.inverse_depth / truth.inverse_depth - 1).abs().max()) < 2e-3


def test_a_term_of_more_than_depths_is_refused_on_the_gpu(monkeypatch):
    use_emulator(monkeypatch, cuda_dense)
    grid, truth = scene()
    problem = replace(
        truth,
        depth_terms=(ScaledPrior(truth.inverse_depth, 1.0),),
        block=Scales(torch.ones(4, dtype=torch.float64)),
    )
    with pytest.raises(TypeError, match="ScaledPrior"):
        cuda_dense.CudaDenseBundle(grid).solve(problem, OPTIONS)
