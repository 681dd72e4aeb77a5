"""The specification of the joint depth and scale step: slow, dense, float64, by autograd."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.problem import BundleProblem
from geogs.geometry.lie import se3_inverse
from geogs.tracking.depth_prior import DEPTH_DAMPING, SCALE_DAMPING
from geogs.world.grid import SampleGrid
from oracles.bundle_reference import reproject


def scale_field(grid: SampleGrid, scale: Float[Tensor, "r c"]) -> Float[Tensor, "p"]:
    """The nodes' scales, bilinear in between."""
    size = (grid.height, grid.width)
    return F.interpolate(scale[None, None], size, mode="bilinear", align_corners=True).reshape(-1)


def residuals(
    grid: SampleGrid,
    problem: BundleProblem,
    frame: int,
    prior: Float[Tensor, "p"],
    depth: Float[Tensor, "p"],
    scale: Float[Tensor, "r c"],
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "p"]]:
    """Residuals of the matches of a frame's edges in pixels, and of its prior in inverse depth."""
    rows = []
    for e in torch.nonzero(problem.source == frame)[:, 0].tolist():
        T = problem.T_cw[int(problem.target[e])] @ se3_inverse(problem.T_cw[frame])
        pixels, _ = reproject(grid.camera, grid.rays.double(), T, depth)
        rows.append(problem.pixels[e].double() - pixels)
    return torch.stack(rows), depth - scale_field(grid, scale) * prior


def joint_step(
    grid: SampleGrid,
    problem: BundleProblem,
    frame: int,
    prior: Float[Tensor, "p"],
    scale: Float[Tensor, "r c"],
    alpha: Float[Tensor, "p"],
    huber: float,
    scale_step: float = torch.inf,
) -> tuple[Float[Tensor, "p"], Float[Tensor, "r c"]]:
    """Steps of one frame's inverse depths and scales from the full normal equations."""
    p = len(prior)
    edges = problem.source == frame
    d, prior, s, alpha = (v.double() for v in (problem.inverse_depth[frame], prior, scale, alpha))
    flow, _ = residuals(grid, problem, frame, prior, d, s)
    weight = problem.weight[edges].double()
    norm = (weight * flow * flow).sum(-1, keepdim=True).sqrt()
    root = (weight * (huber / norm.clamp(min=huber))).sqrt()

    def weighted(x: Float[Tensor, "q"]) -> Float[Tensor, "m"]:
        nodes = x[p:].reshape(scale.shape)
        a, b = residuals(grid, problem, frame, prior, x[:p], nodes)
        across, down = nodes.diff(dim=1), nodes.diff(dim=0)
        steps = torch.cat([across.reshape(-1), down.reshape(-1)]) / (scale_step * s.mean())
        return torch.cat([(root * a).reshape(-1), alpha.sqrt() * b, steps])

    x = torch.cat([d, s.reshape(-1)])
    J, r = torch.func.jacrev(weighted)(x), weighted(x)
    H = J.mT @ J
    curvature = (J[: flow.numel(), :p].square()).sum(0)
    damping = torch.where(alpha > 0, 0.0, DEPTH_DAMPING * curvature.mean() + 1e-8)
    own = J[flow.numel() : flow.numel() + p, p:].square().sum(0)
    scales = SCALE_DAMPING * own + 1e-12
    step = torch.linalg.solve(H + torch.diag(torch.cat([damping, scales])), -J.mT @ r)
    return step[:p], step[p:].reshape(scale.shape)
