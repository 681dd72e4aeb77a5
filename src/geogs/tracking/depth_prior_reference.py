"""The specification of the joint depth and scale step: slow, dense, float64, by autograd."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.tracking.bundle import BundleProblem
from geogs.tracking.bundle_reference import reproject
from geogs.tracking.depth_prior import DEPTH_DAMPING, SCALE_DAMPING
from geogs.tracking.grid import SampleGrid


def scale_field(grid: SampleGrid, scale: Float[Tensor, "4"]) -> Float[Tensor, "p"]:
    """The corners' scales, bilinear in between."""
    size = (grid.height, grid.width)
    corners = scale.reshape(1, 1, 2, 2)
    return F.interpolate(corners, size, mode="bilinear", align_corners=True).reshape(-1)


def residuals(
    grid: SampleGrid,
    problem: BundleProblem,
    frame: int,
    prior: Float[Tensor, "p"],
    depth: Float[Tensor, "p"],
    scale: Float[Tensor, "4"],
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "p"]]:
    """Of the matches of a frame's edges in pixels, and of its prior in inverse depth."""
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
    scale: Float[Tensor, "4"],
    alpha: Float[Tensor, "p"],
    huber: float,
) -> tuple[Float[Tensor, "p"], Float[Tensor, "4"]]:
    """Steps of one frame's inverse depths and scales from the full normal equations."""
    p = len(prior)
    edges = problem.source == frame
    d, prior, s, alpha = (v.double() for v in (problem.inverse_depth[frame], prior, scale, alpha))
    flow, _ = residuals(grid, problem, frame, prior, d, s)
    weight = problem.weight[edges].double()
    norm = (weight * flow * flow).sum(-1, keepdim=True).sqrt()
    root = (weight * (huber / norm.clamp(min=huber))).sqrt()

    def weighted(x: Float[Tensor, "q"]) -> Float[Tensor, "m"]:
        a, b = residuals(grid, problem, frame, prior, x[:p], x[p:])
        return torch.cat([(root * a).reshape(-1), alpha.sqrt() * b])

    x = torch.cat([d, s])
    J, r = torch.func.jacrev(weighted)(x), weighted(x)
    H = J.mT @ J
    curvature = (J[: flow.numel(), :p].square()).sum(0)
    damping = torch.where(alpha > 0, 0.0, DEPTH_DAMPING * curvature.mean() + 1e-8)
    scales = SCALE_DAMPING * H.diagonal()[p:] + 1e-12
    step = torch.linalg.solve(H + torch.diag(torch.cat([damping, scales])), -J.mT @ r)
    return step[:p], step[p:]
