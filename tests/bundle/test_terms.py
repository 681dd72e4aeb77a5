"""New kinds of measurements: each is one class, here, and enters a problem by one line."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

import geogs.bundle.cuda.dense as cuda_dense
from bundle_scenes import CAMERA, disturbed, scene, streamed
from cuda_emulator import use_emulator
from geogs.bundle.dense import DenseBundle
from geogs.bundle.hyper_edge import HyperEdge
from geogs.bundle.problem import BundleProblem
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.streamed import StreamedBundle
from geogs.bundle.terms import BundleState, MeasuredDepths, MeasuredMotions
from geogs.geometry.lie import move, retract, se3_exp, se3_inverse
from oracles.bundle_reference import gauss_newton_step

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


TRUE = torch.tensor([1e4] * 3 + [1e5] * 3, dtype=torch.float64)


def chained(truth: BundleProblem, noise: float, information=TRUE, seed: int = 5) -> MeasuredMotions:
    """The motion from each frame to the next, with an error of each of its six numbers."""
    n, g = len(truth.T_cw), torch.Generator().manual_seed(seed)
    motion = truth.T_cw[1:] @ se3_inverse(truth.T_cw[:-1])
    off = noise * torch.randn(n - 1, 6, generator=g, dtype=torch.float64)
    at = torch.arange(n - 1)
    return MeasuredMotions(at, at + 1, se3_exp(off) @ motion, information.expand(n - 1, 6))


def centres(T_cw):
    return se3_inverse(T_cw)[:, :3, 3]


@pytest.mark.parametrize("noise", [0.01, 0.8])
def test_jacobians_match_finite_differences(noise):
    _, truth = scene()
    motions, T = chained(truth, noise), truth.T_cw
    n, step = len(T), 1e-6
    adjoint, hessian, gradient = motions.equations(T)
    trust = motions.robust_weight(motions.residual(T))
    for m, (i, j) in enumerate(zip(motions.source, motions.target, strict=True)):
        numeric = []
        for k in range(12):
            xi = torch.zeros(n, 6, dtype=torch.float64)
            xi[(j, i)[k // 6], k % 6] = step
            ahead, behind = (motions.residual(move(s * xi, T))[m] for s in (1, -1))
            numeric.append((ahead - behind) / (2 * step))
        J = torch.stack(numeric, 1)
        W = trust[m] * torch.diag(motions.information[m])
        e = motions.residual(T)[m]
        chain = torch.cat([torch.eye(6, dtype=torch.float64), -adjoint[m]], 1)
        size = float((J.mT @ W @ J).abs().max())
        exact = {"rtol": 1e-6, "atol": 1e-7 * size}
        torch.testing.assert_close(chain.mT @ hessian[m] @ chain, J.mT @ W @ J, **exact)
        torch.testing.assert_close(chain.mT @ gradient[m], -J.mT @ W @ e, **exact)


def test_step_matches_dense_normal_equations():
    grid, truth = scene()
    free_depth = truth.free_depth.clone()
    free_depth[1] = False
    start = replace(
        disturbed(truth, 0.02, 0.05), pose_terms=(chained(truth, 0.02),), free_depth=free_depth
    )
    options = BundleOptions(iterations=1, huber=0.5)
    xi, delta = gauss_newton_step(start, CAMERA, grid.rays, options)
    result = DenseBundle(grid).solve(start, options)
    torch.testing.assert_close(result.T_cw, retract(xi, start.T_cw), rtol=0, atol=2e-5)
    expected = start.inverse_depth.double() + delta
    torch.testing.assert_close(result.inverse_depth.double(), expected, rtol=0, atol=5e-5)
    plain = DenseBundle(grid).solve(replace(start, pose_terms=()), options)
    assert float((plain.T_cw - result.T_cw).abs().max()) > 1e-3


def test_streamed_steps_are_those_of_the_dense_solver():
    grid, truth = scene(frames=6)
    p = replace(disturbed(truth, 0.02, 0.05), pose_terms=(chained(truth, 0.02),))
    # No match joins 3 with 4: only what was measured does.
    near = ((p.source - p.target).abs() <= 2) & ((p.source < 4) == (p.target < 4))
    p = replace(
        p, source=p.source[near], target=p.target[near], pixels=p.pixels[near],
        weight=p.weight[near],
    )  # fmt: skip
    options = BundleOptions(iterations=3, huber=0.5, chunk=3)
    slow, fast = (
        DenseBundle(grid).solve(p, options),
        StreamedBundle(grid).solve(streamed(p), options),
    )
    assert fast.finite
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=1e-6)
    torch.testing.assert_close(fast.inverse_depth, slow.inverse_depth, rtol=1e-5, atol=1e-6)


def of_wrong_size(truth: BundleProblem) -> BundleProblem:
    """All lengths 20 % too small; only the first pose is held, so that no match can tell."""
    free = torch.ones(len(truth.T_cw), dtype=torch.bool)
    free[0] = False
    T = truth.T_cw.clone()
    shift = T[1:, :3, 3] - (T[1:, :3, :3] @ T[0, :3, :3].mT) @ T[0, :3, 3]
    T[1:, :3, 3] -= 0.2 * shift
    d = truth.inverse_depth / 0.8
    return replace(truth, T_cw=T, inverse_depth=d, free_pose=free)


def test_measured_motions_say_how_long_a_step_is():
    grid, truth = scene(frames=6)
    start = replace(of_wrong_size(truth), pose_terms=(chained(truth, 0.0),))
    options = BundleOptions(iterations=40, huber=10.0, damping=1e-8)
    result = DenseBundle(grid).solve(start, options)
    before = (centres(start.T_cw) - centres(truth.T_cw)).norm(dim=1).max()
    after = (centres(result.T_cw) - centres(truth.T_cw)).norm(dim=1).max()
    assert float(after) < 0.02 * float(before)


def test_motions_that_are_wrong_altogether_are_out_voted():
    grid, truth = scene(frames=8)
    motions = chained(truth, 0.0)
    wrong = motions.T_ts.clone()
    wrong[3] = se3_exp(torch.tensor([0.5, -0.3, 0.4, 0.2, 0.5, -0.4], dtype=torch.float64))
    start = disturbed(truth, 0.005, 0.01)
    options = BundleOptions(iterations=12, huber=10.0)
    found = {}
    for name, T in (("right", motions.T_ts), ("wrong", wrong)):
        problem = replace(start, pose_terms=(replace(motions, T_ts=T),))
        result = DenseBundle(grid).solve(problem, options)
        found[name] = float((centres(result.T_cw) - centres(truth.T_cw)).norm(dim=1).max())
    assert found["right"] < 1e-4
    assert found["wrong"] < 3e-4
    e = replace(motions, T_ts=wrong).residual(truth.T_cw)
    trust = replace(motions, T_ts=wrong).robust_weight(e)
    assert float(trust[3]) < 1e-3
    assert float(trust[:3].min()) > 0.999
