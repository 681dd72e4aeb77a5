"""Exact matches between a few views seen through a lens, for tests of self-calibration."""

from dataclasses import replace

import torch

from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.world.grid import SampleGrid

CAMERA = Camera(fx=70.0, fy=72.0, cx=39.0, cy=29.0, width=80, height=60)
GRID = SampleGrid(CAMERA)


def lens_problem(lens: Camera, frames: int = 5, noise: float = 0.0, seed: int = 0) -> BundleProblem:
    """Views of smooth random depth about 2 units away; noise in pixels, weights to match."""
    g = torch.Generator().manual_seed(7)
    size = torch.tensor([0.25, 0.25, 0.25, 0.12, 0.12, 0.12], dtype=torch.float64)
    T = se3_exp(size * torch.randn(frames, 6, generator=g, dtype=torch.float64))
    T[0] = torch.eye(4, dtype=torch.float64)
    d = 0.4 + 0.3 * torch.rand(frames, GRID.size, generator=g)
    pairs = [(i, j) for i in range(frames) for j in range(frames) if i != j]
    source, target = (torch.tensor([p[k] for p in pairs]) for k in (0, 1))
    exact = LensBlock(lens, GRID.pixels).project(T, source, target, d[source])
    g = torch.Generator().manual_seed(seed)
    pixels = exact.pixels + noise * torch.randn(exact.pixels.shape, generator=g)
    weight = exact.valid[..., None].expand_as(pixels) / max(noise, 0.1) ** 2
    free = torch.ones(frames, dtype=torch.bool)
    free[0] = False
    return BundleProblem(
        T, d, source, target, free, torch.ones_like(free), pixels=pixels, weight=weight
    )


def disturbed(problem: BundleProblem, pose: float, depth: float) -> BundleProblem:
    """The problem from other poses and inverse depths."""
    g = torch.Generator().manual_seed(1)
    xi = pose * torch.randn(len(problem.T_cw), 6, generator=g, dtype=torch.float64)
    xi[0] = 0
    factor = 1 + depth * torch.randn(problem.inverse_depth.shape, generator=g)
    return replace(
        problem, T_cw=se3_exp(xi) @ problem.T_cw, inverse_depth=problem.inverse_depth * factor
    )
