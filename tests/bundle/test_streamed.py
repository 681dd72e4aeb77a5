"""The adjustment of large problems: the same steps as the dense solver, in bounded memory."""

from dataclasses import replace

import pytest
import torch

from bundle_scenes import disturbed, scene, streamed
from geogs.bundle.dense import DenseBundle
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.streamed import StreamedBundle
from geogs.bundle.terms import DepthDamping, MeasuredDepths


@pytest.mark.parametrize("chunk", [1, 100])
@pytest.mark.parametrize("damped", [False, True])
def test_steps_are_those_of_the_dense_solver(chunk, damped):
    grid, problem = scene(frames=6)
    problem = disturbed(problem, 0.02, 0.05)
    free_depth = problem.free_depth.clone()
    free_depth[1] = False
    g = torch.Generator().manual_seed(4)
    damping = 500 * torch.rand(problem.inverse_depth.shape, generator=g)
    measured = MeasuredDepths(problem.inverse_depth + 0.03, 2e3 * damping / 500)
    terms = (DepthDamping(damping), measured) if damped else ()
    # Not all frames see each other, and one is seen by none.
    near = ((problem.source - problem.target).abs() <= 2) & (problem.source != 5)
    near &= problem.target != 5
    problem = replace(
        problem, free_depth=free_depth, depth_terms=terms,
        source=problem.source[near], target=problem.target[near],
        pixels=problem.pixels[near], weight=problem.weight[near],
    )  # fmt: skip
    options = BundleOptions(iterations=3, huber=0.5, chunk=chunk)
    slow = DenseBundle(grid).solve(problem, options)
    fast = StreamedBundle(grid).solve(streamed(problem), options)
    assert fast.finite
    assert float((slow.T_cw - problem.T_cw).abs().max()) > 0.01
    torch.testing.assert_close(fast.T_cw, slow.T_cw, rtol=0, atol=1e-6)
    torch.testing.assert_close(fast.inverse_depth, slow.inverse_depth, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(fast.information, slow.information, rtol=1e-4, atol=1e-3)
    assert torch.equal(fast.T_cw[:2], problem.T_cw[:2])


def test_steps_that_are_not_finite_are_refused():
    grid, problem = scene()
    pixels = problem.pixels.clone()
    pixels[0, 0] = torch.nan
    bad = streamed(replace(problem, pixels=pixels))
    result = StreamedBundle(grid).solve(bad, BundleOptions())
    assert not result.finite
    assert torch.equal(result.T_cw, problem.T_cw)
    assert torch.equal(result.inverse_depth, problem.inverse_depth)


def test_small_steps_end_the_adjustment():
    grid, truth = scene()
    start = disturbed(truth, 0.02, 0.05)
    options = BundleOptions(iterations=50, huber=10.0, tolerance=0.5)
    one = BundleOptions(iterations=1, huber=10.0)
    for solver, problem in ((DenseBundle(grid), start), (StreamedBundle(grid), streamed(start))):
        assert torch.equal(solver.solve(problem, options).T_cw, solver.solve(problem, one).T_cw)
