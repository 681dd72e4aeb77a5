"""Small bundle adjustments with known answers."""

from dataclasses import replace

import torch

from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.projection import project, relative_motion
from geogs.geometry.camera import Camera
from geogs.geometry.lie import retract, se3_exp
from geogs.world.grid import SampleGrid

CAMERA = Camera(fx=70.0, fy=72.0, cx=39.0, cy=29.0, width=80, height=60)


def scene(frames: int = 4, seed: int = 0) -> tuple[SampleGrid, BundleProblem]:
    """Exact flow between a few views of smooth random depth, weights at random."""
    g = torch.Generator().manual_seed(seed)
    grid = SampleGrid(CAMERA)
    steps = 0.1 * torch.randn(frames, 6, generator=g, dtype=torch.float64)
    T = se3_exp(steps * torch.tensor([1, 1, 1, 0.3, 0.3, 0.3], dtype=torch.float64))
    d = 0.4 + 0.3 * torch.rand(frames, grid.size, generator=g)
    pairs = [(i, j) for i in range(frames) for j in range(frames) if i != j]
    source, target = (torch.tensor([p[k] for p in pairs]) for k in (0, 1))
    pixels = project(CAMERA, grid.rays, relative_motion(T, source, target), d[source]).pixels
    weight = 0.5 + 4 * torch.rand(len(pairs), grid.size, 2, generator=g)
    free = torch.ones(frames, dtype=torch.bool)
    free[:2] = False
    return grid, BundleProblem(
        T, d, source, target, free, torch.ones_like(free), pixels=pixels, weight=weight
    )


def disturbed(problem: BundleProblem, pose: float, depth: float, seed: int = 1) -> BundleProblem:
    g = torch.Generator().manual_seed(seed)
    xi = pose * torch.randn(len(problem.T_cw), 6, generator=g, dtype=torch.float64)
    d = problem.inverse_depth * (1 + depth * torch.randn(problem.inverse_depth.shape, generator=g))
    return replace(
        problem,
        T_cw=torch.where(problem.free_pose[:, None, None], retract(xi, problem.T_cw), problem.T_cw),
        inverse_depth=torch.where(problem.free_depth[:, None], d, problem.inverse_depth),
    )


def streamed(p: BundleProblem) -> StreamedProblem:
    """The same problem, whose matches are fetched when they are needed."""
    return StreamedProblem(
        p.T_cw, p.inverse_depth, p.source, p.target, p.free_pose, p.free_depth, p.depth_terms,
        p.pose_terms, matches=lambda e: (p.pixels[e], p.weight[e]),
    )  # fmt: skip


def on(p: BundleProblem, device: torch.device) -> BundleProblem:
    """The same problem with its dense tensors on a device, poses and structure on the CPU."""
    dense = {n: getattr(p, n).to(device) for n in ("inverse_depth", "pixels", "weight")}
    terms = (replace(t, **{n: x.to(device) for n, x in vars(t).items()}) for t in p.depth_terms)
    return replace(p, **dense, depth_terms=tuple(terms))
