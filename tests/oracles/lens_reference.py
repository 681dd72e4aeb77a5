"""Edges seen through a lens with unknowns, in plain PyTorch: what compiled loops are held to."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import BEHIND, weighed_residuals
from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import CellProjection, motion_rows, relative_motion, seen_from_targets
from geogs.geometry.robust import huber_cost


class Equations(NamedTuple):
    """Normal equations of each edge: motion, lens and other shared parameters, depths."""

    hessian: Tensor  # (e, c, c)
    gradient: Tensor  # (e, c)
    coupling: Tensor  # (e, c, p)
    curvature: Tensor  # (e, p)
    pull: Tensor  # (e, p)


def linearised(
    block: LensBlock, T_cw: Tensor, source: Tensor, target: Tensor, inverse_depth: Tensor
) -> tuple[CellProjection, Tensor, Tensor]:
    """Where cells fall, and the derivatives of that: (e, 9, 2, p) by the motion (left perturbation)
    and the lens, (e, 2, p) by the inverse depths."""
    lens, rays, T_ji = block.lens, block.rays, relative_motion(T_cw, source, target)
    y, _, z = seen_from_targets(rays, T_ji, inverse_depth)
    x, c, q = y[..., :2] / z[..., None], lens, 1 / z
    u, v = x.unbind(-1)
    R, t = T_ji[:, :3, :3].to(inverse_depth), T_ji[:, :3, 3].to(inverse_depth)
    tx, ty, tz = t[:, None].unbind(-1)
    # A change of the lens moves the ray by a factor of (x, y, 0).
    ray = (rays[:, :2] @ R[:, :, :2].mT).unbind(-1)
    along_x, along_y = (ray[0] - ray[2] * u) * q, (ray[1] - ray[2] * v) * q
    row_x = [*(along_x * slope for slope in block.slopes), (tx - tz * u) * q]
    row_y = [*(along_y * slope for slope in block.slopes), (ty - tz * v) * q]
    others = torch.stack([torch.stack(row_x, 1), torch.stack(row_y, 1)], 2)
    J = torch.cat([torch.stack(motion_rows(u, v, inverse_depth * q), 2), others], 1)
    xx, xy, yy = (each[:, None] for each in lens.bend_jacobian(x))
    J = torch.stack([xx * J[:, :, 0] + xy * J[:, :, 1], xy * J[:, :, 0] + yy * J[:, :, 1]], 2)
    J = J * J.new_tensor([c.fx, c.fy])[:, None]
    p = block.project(T_cw, source, target, inverse_depth)
    centred = (p.pixels - p.pixels.new_tensor([c.cx, c.cy])).mT
    flat = (x * p.pixels.new_tensor([c.fx, c.fy])).mT
    _, by_k1, by_k2 = lens.radial_shapes(u * u + v * v)
    own = torch.stack([centred, flat * by_k1[:, None], flat * by_k2[:, None]], 1)
    return p, torch.cat([J[:, :6], J[:, 6:9] + own], 1), J[:, 9]


def equations(
    problem: BundleProblem, block: LensBlock, huber: float, further: Tensor | None = None
) -> Equations:
    """Normal equations of all edges of a problem, summed in float64."""
    i, j, T = problem.source, problem.target, problem.T_cw
    block = LensBlock(block.lens, block.pixels.double())
    p, J, Jd = linearised(block, T, i, j, problem.inverse_depth[i].double())
    if further is not None:
        J = torch.cat([J, further.mT], 1)
    r, w = (x.mT for x in weighed_residuals(p, problem.pixels, problem.weight, huber))
    return Equations(
        torch.einsum("ekap,elap,eap->ekl", J, J, w.double()),
        torch.einsum("ekap,eap,eap->ek", J, r.double(), w.double()),
        torch.einsum("ekap,eap,eap->ekp", J, Jd, w.double()),
        (Jd * Jd * w).sum(1),
        (Jd * r * w).sum(1),
    )


def cost(problem: BundleProblem, block: LensBlock, huber: float) -> float:
    """Cost of all matches of a problem."""
    depth = problem.inverse_depth[problem.source]
    p = block.project(problem.T_cw, problem.source, problem.target, depth)
    return matched_cost(p, problem.pixels, problem.weight, huber)


def matched_cost(
    p: CellProjection, pixels: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"], huber: float
) -> float:
    """Huber's cost of all matched cells; one behind its target is ``BEHIND`` hubers off."""
    x, y = (weight * (pixels - p.pixels).square()).unbind(-1)
    cost = huber_cost(torch.where(p.valid, x + y, (BEHIND * huber) ** 2), huber)
    return float(torch.where(weight[..., 0] > 0, cost, 0.0).sum(dtype=torch.float64))
