"""Poses of frames against keyframes that stay fixed."""

import torch

from bundle_scenes import disturbed, scene
from geogs.bundle.motion_only import MotionSolver
from geogs.bundle.problem import MotionProblem


def test_motion_only_recovers_poses():
    grid, truth = scene()
    edges = (truth.source < 2) & (truth.target >= 2)
    source, target = truth.source[edges], truth.target[edges]
    start = disturbed(truth, 0.03, 0.0)
    problem = MotionProblem(
        start.T_cw[2:],
        truth.inverse_depth[source],
        truth.T_cw[source],
        target - 2,
        truth.pixels[edges],
        truth.weight[edges],
    )
    T, residual = MotionSolver(grid).solve(problem, iterations=10)
    torch.testing.assert_close(T, truth.T_cw[2:], rtol=0, atol=1e-5)
    assert float(residual.norm(dim=-1).max()) < 0.01
