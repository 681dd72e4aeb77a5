"""The GPU's adjustment of large problems against the dense solver of the CPU."""

from dataclasses import replace

import pytest
import torch

import geogs.bundle.cuda.streamed as cuda_streamed
from bundle_scenes import disturbed, on, scene, streamed
from cuda_emulator import use_emulator
from geogs.bundle.dense import DenseBundle
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import DepthDamping, MeasuredDepths, MeasuredMotions
from geogs.world.grid import SampleGrid


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch) -> torch.device:
    """Where the kernels run; everything is emulated where there is no GPU."""
    if request.param == "emulated":
        use_emulator(monkeypatch, cuda_streamed)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    return torch.device("cuda")


@pytest.mark.parametrize("edges", [1, 6, 1024])
def test_steps_are_those_of_the_dense_solver(device, edges, monkeypatch):
    monkeypatch.setattr(cuda_streamed, "EDGES_TOGETHER", edges)
    grid, problem = scene(frames=6)
    problem = disturbed(problem, 0.02, 0.05)
    free_depth = problem.free_depth.clone()
    free_depth[1] = False
    g = torch.Generator().manual_seed(4)
    terms = ()
    if edges == 6:
        damping = 500 * torch.rand(problem.inverse_depth.shape, generator=g)
        terms = DepthDamping(damping), MeasuredDepths(problem.inverse_depth + 0.03, 4 * damping)
    # Not all frames see each other, and one is seen by none.
    near = ((problem.source - problem.target).abs() <= 2) & (problem.source != 5)
    near &= problem.target != 5
    problem = replace(
        problem, free_depth=free_depth, depth_terms=terms,
        source=problem.source[near], target=problem.target[near],
        pixels=problem.pixels[near], weight=problem.weight[near],
    )  # fmt: skip
    options = BundleOptions(iterations=2, huber=0.5)
    slow = DenseBundle(grid).solve(problem, options)
    solver = cuda_streamed.CudaStreamedBundle(SampleGrid(grid.camera, device))
    fast = solver.solve(streamed(on(problem, device)), options)
    assert fast.finite
    assert float((slow.T_cw - problem.T_cw).abs().max()) > 0.01
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=2e-5)
    torch.testing.assert_close(fast.inverse_depth.cpu(), slow.inverse_depth, rtol=0, atol=2e-4)
    known = slow.information > 0
    ratio = fast.information.cpu()[known] / slow.information[known]
    assert float((ratio - 1).abs().median()) < 1e-3


def test_measured_motions_count_as_in_the_dense_solver(device):
    grid, truth = scene(frames=4)
    problem = disturbed(truth, 0.02, 0.05)
    ends = torch.tensor([0, 1, 2]), torch.tensor([1, 2, 3])
    motion = truth.T_cw[ends[1]] @ torch.linalg.inv(truth.T_cw[ends[0]])
    motion[:, 0, 3] += 0.002
    motions = MeasuredMotions(*ends, motion, torch.full((3, 6), 1e6, dtype=torch.float64))
    options = BundleOptions(iterations=2, huber=0.5)
    solver = cuda_streamed.CudaStreamedBundle(SampleGrid(grid.camera, device))
    slow, without = (
        DenseBundle(grid).solve(replace(problem, pose_terms=m), options) for m in ((motions,), ())
    )
    fast = solver.solve(streamed(on(replace(problem, pose_terms=(motions,)), device)), options)
    assert float((slow.T_cw - without.T_cw).abs().max()) > 3e-4
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=2e-5)


def test_steps_that_are_not_finite_are_refused(device):
    grid, problem = scene()
    pixels = problem.pixels.clone()
    pixels[0, 0] = torch.nan
    bad = streamed(on(replace(problem, pixels=pixels), device))
    solver = cuda_streamed.CudaStreamedBundle(SampleGrid(grid.camera, device))
    result = solver.solve(bad, BundleOptions())
    assert not result.finite
    assert torch.equal(result.T_cw, problem.T_cw)
    assert torch.equal(result.inverse_depth.cpu(), problem.inverse_depth)


def test_small_steps_end_the_adjustment(device):
    grid, truth = scene()
    start = streamed(on(disturbed(truth, 0.02, 0.05), device))
    solver = cuda_streamed.CudaStreamedBundle(SampleGrid(grid.camera, device))
    ended = solver.solve(start, BundleOptions(iterations=50, huber=10.0, tolerance=0.5))
    one = solver.solve(start, BundleOptions(iterations=1, huber=10.0))
    # Sums on a GPU are not always in the same order.
    torch.testing.assert_close(ended.T_cw, one.T_cw, rtol=0, atol=1e-9)
