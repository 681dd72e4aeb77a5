"""New kinds of measurements: each is one class, here, and enters a problem by one line."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

import geogs.bundle.cuda.dense as cuda_dense
from bundle_scenes import disturbed, scene, streamed
from cuda_emulator import use_emulator
from geogs.bundle.dense import DenseBundle
from geogs.bundle.depth_terms import MeasuredDepths
from geogs.bundle.hyper_edge import HyperEdge
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.streamed import StreamedBundle
from geogs.bundle.terms import BundleState
from geogs.geometry.lie import se3_inverse

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


def test_a_term_of_depths_that_no_kernel_takes_is_refused_on_the_gpu(monkeypatch):
    use_emulator(monkeypatch, cuda_dense)
    grid, truth = scene()
    start = disturbed(truth, 0.02, 0.05)
    measured = MeasuredDepths(truth.inverse_depth, torch.full_like(truth.inverse_depth, 2e3))
    other = replace(measured, inverse_depth=truth.inverse_depth + 0.02)
    options = BundleOptions(2, huber=0.5)
    once, twice = (
        DenseBundle(grid).solve(replace(start, depth_terms=terms), options)
        for terms in ((measured,), (measured, other))
    )
    assert float((once.inverse_depth - twice.inverse_depth).abs().max()) > 1e-3
    with pytest.raises(TypeError, match="MeasuredDepths"):
        cuda_dense.CudaDenseBundle(grid).solve(
            replace(start, depth_terms=(measured, other)), options
        )
