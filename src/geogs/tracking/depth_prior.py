"""Joint adjustment of inverse depth and of the scale of a monocular prior (HI-SLAM2's JDSA).

Poses are fixed. Every keyframe has a multiplicative scale at each node of a coarse grid, bilinear
in between: s(u) = B(u) . s. Inverse depths d and scales minimise

    sum_e w |target - project(d)|^2  +  sum_u alpha(u) (d(u) - s(u) d_prior(u))^2
        +  sum_nodes (s_i - s_j)^2 / step^2 ,

the last sum over neighbouring nodes. HI-SLAM2 has 2 x 2 nodes without that last term, and a fixed
alpha tuned to its network's weights. Here weights of flow are inverse variances, so alpha is one,
too: 1 / (deviation * d)^2. With more nodes, coupled by their usual differences, the prior gives the
shape of a bare wall and the matches around it the scale.

It is no term of :mod:`geogs.bundle` and does not use its loop: a single step is taken, eliminated
in a form that does not cancel, and only the weights of the prior are iterated, from the same start.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import linearise, relative_motion
from geogs.config import PriorConfig
from geogs.world.grid import SampleGrid

DEVIATION = 0.05
"""Relative deviation of a good prior after its scale has been adjusted."""
REACH = 0.06
"""Distance within which matched depth tests the prior, about, as a fraction of the grid's width."""
MAX_DEVIATION = 0.15
"""Relative deviation above which a cell does not use the prior: three times a good one's."""
MAX_DISAGREEMENT = 0.2
"""A prior that is off by more than this in a fifth of the matched cells is not used at all."""
SCALE_DAMPING = 1e-4
"""Damping of the scales, relative to the curvature of the prior's term."""
DEPTH_DAMPING = 1e-3
"""Damping of inverse depth without a prior, relative to the mean curvature of its frame."""
REWEIGHTINGS = 3
"""Rounds of testing and fitting the prior in one adjustment."""
EDGES_TOGETHER = 24
"""Edges that are linearised at a time; bounds memory."""
LIMITS = 1e-3, 1e2
"""Smallest and largest inverse depth after a step."""
_CAUCHY = 2.0
"""Deviations at which a cell of the prior counts half in the fit of the scales."""
_EVIDENCE = ((1.0, 8.0), (3.0, 2.0), (9.0, 0.5))
"""Window sizes in multiples of the reach, and the weight of each, in cells, if full of evidence."""
_BELIEF = 0.5
"""Weight of the deviation of a good prior, in cells of evidence."""
_AGREEING = 0.8
"""Quantile of the matched cells' errors by which a prior is rejected; a bad one fits half."""
_ROUGHNESS = 3.0
"""Ratio of a cell's deviation to the deviation of the scale around it."""


@dataclass(frozen=True)
class FlowEvidence:
    """Term of the matches in the inverse depths of a problem's frames, linearised."""

    curvature: Float[Tensor, "n p"]
    """C = sum w |dp/dd|^2."""
    gradient: Float[Tensor, "n p"]
    """b = sum w r . dp/dd; the step of the matches alone is b / C."""


def node_weights(grid: SampleGrid, rows: int, columns: int) -> Float[Tensor, "p k"]:
    """Return the weight B of each node's scale in each cell; rows sum to one."""
    y, x = (_hats(n, k, grid) for n, k in ((grid.height, rows), (grid.width, columns)))
    return torch.einsum("hr,wc->hwrc", y, x).reshape(grid.size, rows * columns)


def _hats(cells: int, nodes: int, grid: SampleGrid) -> Float[Tensor, "n k"]:
    """Return weights of linear interpolation between nodes along one side of the grid."""
    at = torch.linspace(0, nodes - 1, cells, device=grid.device)[:, None]
    return (1 - (at - torch.arange(nodes, device=grid.device)).abs()).clamp(min=0)


def node_differences(rows: int, columns: int) -> Float[Tensor, "k k"]:
    """Return the matrix L with sum over neighbouring nodes of (s_i - s_j)^2 = s . L s."""
    node = torch.arange(rows * columns).reshape(rows, columns)
    i = torch.cat([node[:, 1:].reshape(-1), node[1:].reshape(-1)])
    j = torch.cat([node[:, :-1].reshape(-1), node[:-1].reshape(-1)])
    D = torch.zeros(len(i), rows * columns)
    edge = torch.arange(len(i))
    D[edge, i] = 1.0
    D[edge, j] = -1.0
    return D.mT @ D


def flow_evidence(grid: SampleGrid, problem: BundleProblem, huber: float) -> FlowEvidence:
    """Compute curvature and gradient of the matches' term in the inverse depth of every frame."""
    d = problem.inverse_depth
    curvature = torch.zeros_like(d)
    gradient = torch.zeros_like(d)
    motion = relative_motion(problem.T_cw, problem.source, problem.target)
    for first in range(0, len(problem.source), EDGES_TOGETHER):
        part = slice(first, first + EDGES_TOGETHER)
        source = problem.source[part].to(d.device)
        p = linearise(grid.camera, grid.rays, motion[part], d[source])
        r, w = weighed_residuals(p, problem.pixels[part], problem.weight[part], huber)
        curvature.index_add_(0, source, (w * p.depth_jacobian.square()).sum(-1))
        gradient.index_add_(0, source, (w * p.depth_jacobian * r).sum(-1))
    return FlowEvidence(curvature, gradient)


def depth_scale_step(
    flow: FlowEvidence,
    inverse_depth: Float[Tensor, "n p"],
    prior: Float[Tensor, "n p"],
    scale: Float[Tensor, "n k"],
    alpha: Float[Tensor, "n p"],
    basis: Float[Tensor, "p k"],
    stiffness: Float[Tensor, "k k"],
) -> tuple[Float[Tensor, "n p"], Float[Tensor, "n k"]]:
    """Return the Gauss-Newton step of inverse depths and scales; frames are independent.

    Inverse depths are eliminated (Schur). The prior's term then fits the scales to the depth from
    matches, d + b / C, with the weight alpha C / (alpha + C) of the difference of two measurements;
    it is formed this way, since H - E C'^-1 E^T would cancel. ``alpha`` is the prior's weight, 0
    where it is unknown; ``stiffness`` is the matrix of the nodes' term for scales of about one.
    """
    C = flow.curvature
    b = flow.gradient
    residual = inverse_depth - prior * (scale @ basis.mT)
    fit = alpha / (alpha + C).clamp(min=1e-30) * prior
    # sum_u weight(u) B(u) B(u)^T of every frame
    S = torch.stack([basis.mT @ (w[:, None] * basis) for w in fit * C * prior]).double()
    g = ((fit * (C * residual + b)) @ basis).double()
    curvature = (alpha * prior.square()) @ basis.square()
    S = S + torch.diag_embed(SCALE_DAMPING * curvature.double() + 1e-12)
    # Scales differ by fractions of their mean, so that the unit of depth does not matter.
    relative = stiffness / scale.double().mean(1).square()[:, None, None]
    S = S + relative
    g = g - (relative @ scale.double()[..., None])[..., 0]
    scale_step = torch.linalg.solve(S, g).to(inverse_depth)
    damping = DEPTH_DAMPING * C.mean(1, keepdim=True) + 1e-8
    curved = C + torch.where(alpha > 0, alpha, damping)
    rest = residual - prior * (scale_step @ basis.mT)
    return (b - alpha * rest) / curved, scale_step


@dataclass(frozen=True)
class AdjustedDepth:
    """Frames after the adjustment."""

    inverse_depth: Float[Tensor, "n p"]
    scale: Float[Tensor, "n k"]
    information: Float[Tensor, "n p"]
    """alpha: the prior's inverse variance of inverse depth; 0 where it is not used."""


def adjust_depth(
    grid: SampleGrid,
    flow: FlowEvidence,
    inverse_depth: Float[Tensor, "n p"],
    prior: Float[Tensor, "n p"],
    scale: Float[Tensor, "n k"],
    config: PriorConfig,
) -> AdjustedDepth:
    """Take one JDSA step, with each prior weighted by its agreement with the matches.

    The scales are fitted, the prior is tested by the depth from matches (:func:`local deviation
    <local_deviation>`), and this is repeated with the new weights. Cells with a bad prior, and
    frames where it is bad overall, keep the depth from matches. Without ``config.reject`` every
    cell has the weight of a good prior, as in JDSA itself.
    """
    basis = node_weights(grid, config.scale_rows, config.scale_columns)
    stiffness = node_differences(config.scale_rows, config.scale_columns).to(basis).double()
    stiffness = stiffness / config.scale_step**2
    alpha = _prior_weight(prior, scale, basis, torch.full_like(prior, DEVIATION))
    if config.reject:
        alpha = _judged(grid, flow, inverse_depth, prior, scale, alpha, basis, stiffness)
    depth_step, scale_step = depth_scale_step(
        flow, inverse_depth, prior, scale, alpha, basis, stiffness
    )
    good = (torch.isfinite(depth_step).all(1) & torch.isfinite(scale_step).all(1))[:, None]
    good &= (scale + scale_step > 0).all(1, keepdim=True)
    taken = good & (alpha > 0)  # cells without the prior have just been adjusted to the matches
    return AdjustedDepth(
        torch.where(taken, (inverse_depth + depth_step).clamp(*LIMITS), inverse_depth),
        torch.where(good, scale + scale_step, scale),
        torch.where(good, alpha, 0.0),
    )


def _judged(
    grid: SampleGrid,
    flow: FlowEvidence,
    inverse_depth: Float[Tensor, "n p"],
    prior: Float[Tensor, "n p"],
    scale: Float[Tensor, "n k"],
    alpha: Float[Tensor, "n p"],
    basis: Float[Tensor, "p k"],
    stiffness: Float[Tensor, "k k"],
) -> Float[Tensor, "n p"]:
    """Weight priors by their agreement with the matches, starting from weights ``alpha``."""
    C = flow.curvature
    wanted = inverse_depth + torch.where(C > 0, flow.gradient / C.clamp(min=1e-30), 0.0)
    deviation = torch.full_like(prior, DEVIATION)
    trust = torch.ones_like(prior)
    for _ in range(REWEIGHTINGS):
        _, step = depth_scale_step(
            flow, inverse_depth, prior, scale, alpha * trust, basis, stiffness
        )
        factor = (scale + step) @ basis.mT
        fitted = prior * factor
        known = (prior > 0) & (fitted > 0)
        error = torch.where(known, wanted / fitted.clamp(min=1e-12) - 1, 0.0)
        own = (deviation * fitted).square() + 1 / C.clamp(min=1e-12)
        trust = 1 / (1 + (error * fitted).square() / (_CAUCHY**2 * own))
        confidence = known * C / (C + alpha.clamp(min=1e-12))
        deviation = local_deviation(grid, error, confidence)
        deviation = torch.hypot(deviation, _ROUGHNESS * roughness(grid, factor))
        alpha = _prior_weight(prior, scale, basis, deviation)
    overall = _weighted_quantile(error.abs(), confidence, _AGREEING)
    used = (deviation < MAX_DEVIATION) & (overall < MAX_DISAGREEMENT)[:, None]
    used &= (scale + step > 0).all(1, keepdim=True)
    return torch.where(used, trust * alpha, 0.0)


def local_deviation(
    grid: SampleGrid, error: Float[Tensor, "n p"], confidence: Float[Tensor, "n p"]
) -> Float[Tensor, "n p"]:
    """Estimate the prior's relative deviation in every cell from errors in well-known cells nearby.

    The root of a weighted mean of squared errors in windows of three sizes, of which smaller ones
    count more, and of the variance of a good prior, which alone remains where nothing is known.
    ``confidence`` in [0, 1]: information of the matches on a cell, relative to that of the prior.
    """
    shape = (-1, grid.height, grid.width)
    square = (confidence * error.square().clamp(max=1.0)).reshape(shape)
    both = torch.cat([square, confidence.reshape(shape)])
    around = torch.full_like(both, _BELIEF, dtype=torch.float64)
    around[: len(square)] *= DEVIATION**2
    for multiple, cells in _EVIDENCE:
        around += cells * mean_around(both, multiple * REACH * grid.width)
    total, count = around.chunk(2)
    return (total / count).sqrt().reshape(error.shape).to(error)


def roughness(grid: SampleGrid, factor: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Return the relative deviation of the scale within reach of a cell.

    A scale that changes fast to follow the matches is unreliable between them.
    """
    radius = REACH * grid.width
    field = factor.double().reshape(-1, grid.height, grid.width)
    mean, square = mean_around(torch.cat([field, field.square()]), radius).chunk(2)
    variance = (square - mean.square()).clamp(min=0)
    return (variance.sqrt() / mean.abs().clamp(min=1e-12)).reshape(factor.shape).to(factor)


def mean_around(field: Float[Tensor, "n h w"], radius: float) -> Float[Tensor, "n h w"]:
    """Return the mean over a square window, cut at the border; float64."""
    k = max(1, round(radius))
    return _means_along(_means_along(field.double(), k).mT, k).mT


def _means_along(field: Float[Tensor, "n h w"], k: int) -> Float[Tensor, "n h w"]:
    """Return means along rows over the k cells on either side, from a running sum."""
    width = field.shape[-1]
    running = F.pad(field.cumsum(-1), (1, 0))
    at = torch.arange(width, device=field.device)
    first = (at - k).clamp(min=0)
    end = (at + k + 1).clamp(max=width)
    return (running[..., end] - running[..., first]) / (end - first)


def _prior_weight(
    prior: Float[Tensor, "n p"],
    scale: Float[Tensor, "n k"],
    basis: Float[Tensor, "p k"],
    deviation: Float[Tensor, "n p"],
) -> Float[Tensor, "n p"]:
    """Return alpha = 1 / (deviation s d_prior)^2, 0 where there is no prior."""
    scaled = prior * (scale @ basis.mT)
    known = scaled > 0
    return torch.where(known, 1 / (deviation * scaled).square().clamp(min=1e-30), 0.0)


def _weighted_quantile(
    values: Float[Tensor, "n p"], weight: Float[Tensor, "n p"], fraction: float
) -> Float[Tensor, "n"]:
    """Return the weighted quantile of every row; NaN without weight."""
    ordered, order = values.sort(dim=1)
    total = weight.gather(1, order).cumsum(1)
    place = torch.searchsorted(total, fraction * total[:, -1:]).clamp(max=values.shape[1] - 1)
    return torch.where(total[:, -1] > 0, ordered.gather(1, place)[:, 0], torch.nan)
