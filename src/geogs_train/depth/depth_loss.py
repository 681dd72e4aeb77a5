"""The loss of the depth network: depth, its deviation, normals, their concentration.

All of it is unit-free: depths are compared in their logarithms. Standard deviations, outliers and
concentrations learn from the likelihood of detached errors, so that hard pixels are not given up.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from geogs.depth.network.plane_views import cell_rays, plane_step
from geogs.depth.network.stereo_views import DepthPrediction
from geogs.depth.network.surface_normals import normals_of
from geogs_train.depth.depth_options import DepthLossOptions
from geogs_train.depth.depth_tuples import DepthBatch, has_truth

SMOOTH = 0.985
"""Least cosine between true normals and those of true depth of a pixel that is no edge."""
CELL_SPREAD = 0.05
"""Range of log depth in a coarse cell from which it has two depths."""
NEAR_EDGE = 4
"""Pixels around a pixel within which another depth makes it an edge pixel."""
CHOICE = 0.15
"""Temperature of the targets for the tried depths at 1/2, in steps between planes."""
SCALES = 4
"""Number of scales of differences; each has twice the distance of the one before."""


def depth_loss(
    found: DepthPrediction, batch: DepthBatch, options: DepthLossOptions
) -> Float[Tensor, ""]:
    """The sum of all parts."""
    valid = has_truth(batch)
    typical = batch.views.typical[:, None, None].expand_as(batch.depth)
    # A ray may meet nothing, but invalid pixels must be numbers, too.
    truth = (torch.where(valid, batch.depth, typical) / typical).log()
    error = found.log_depth - truth
    at_edge = spread_around(truth, valid, NEAR_EDGE) > CELL_SPREAD
    total = _mean((1 + options.edges * at_edge) * error.abs(), valid)
    for level, coarse in ((1, found.at_half), (2, found.at_quarter)):
        nearest, farthest, known = surfaces_of_cells(truth, valid, 2**level)
        coarse = coarse[:, : known.shape[1], : known.shape[2]]
        total = total + 2.0**-level * _mean(from_either(coarse, nearest, farthest), known)
    total = total + options.gradient * gradient_loss(error, valid)
    total = total + options.choice * choice_loss(found, truth, valid)

    height, width = truth.shape[-2:]
    rays = cell_rays(batch.views.intrinsics, height, width, 1).unflatten(2, (height, width))
    smooth = valid & ((normals_of(truth, rays) * batch.normal).sum(1) > SMOOTH)
    bent = normals_of(found.log_depth, rays)
    total = total + options.bent * _mean(0.5 * (1 - (bent * batch.normal).sum(1)), smooth)
    total = total + options.agreement * _mean(1 - (found.normal * bent).sum(1), smooth)
    for weight, logits in (
        (options.planes, found.plane_logits),
        (options.scores, found.plane_scores),
    ):
        total = total + weight * plane_loss(logits, found.log_planes, truth, valid)

    late = float(batch.progress >= options.late)
    # The derivative of the angle is infinite at zero.
    angle = (found.normal * batch.normal).sum(1).clamp(-1 + 1e-5, 1 - 1e-5).arccos()
    total = total + options.normal * _mean(angle, valid)
    spread = angular(angle.detach(), found.concentration)
    total = total + options.spread * late * _mean(spread, valid)
    log_range = (batch.views.far / batch.views.near).log()[:, None, None]
    likelihood = outlier_laplace(error.detach(), found.log_scale, found.outlier, log_range)
    return total + options.likelihood * late * _mean(likelihood, valid)


def surfaces_of_cells(
    log_depth: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"], cell: int
) -> tuple[Float[Tensor, "b h2 w2"], Float[Tensor, "b h2 w2"], Bool[Tensor, "b h2 w2"]]:
    """Two depths of each cell of ``cell`` x ``cell`` pixels (twice the mean of a cell on one
    surface, else its nearest and farthest pixel), and a mask of the fully known cells."""
    depth = log_depth[:, None]
    mean = functional.avg_pool2d(depth, cell)[:, 0]
    farthest = functional.max_pool2d(depth, cell)[:, 0]
    nearest = -functional.max_pool2d(-depth, cell)[:, 0]
    one = farthest - nearest < CELL_SPREAD
    known = -functional.max_pool2d(-valid[:, None].float(), cell)[:, 0] > 0.5
    return torch.where(one, mean, nearest), torch.where(one, mean, farthest), known


def from_either(
    found: Float[Tensor, "b h w"], nearest: Float[Tensor, "b h w"], farthest: Float[Tensor, "b h w"]
) -> Float[Tensor, "b h w"]:
    """Distance to the closer of two surfaces, between which there is no depth."""
    return torch.minimum((found - nearest).abs(), (found - farthest).abs())


def spread_around(
    log_depth: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"], reach: int
) -> Float[Tensor, "b h w"]:
    """Largest minus smallest depth of the known pixels within ``reach`` across and down."""
    size = 2 * reach + 1
    low = torch.where(valid, log_depth, torch.inf)[:, None]
    high = torch.where(valid, log_depth, -torch.inf)[:, None]
    farthest = functional.max_pool2d(high, size, 1, reach)
    return (farthest + functional.max_pool2d(-low, size, 1, reach))[:, 0]


def choice_loss(
    found: DepthPrediction, truth: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"]
) -> Float[Tensor, ""]:
    """Cross-entropy of the tried depths at 1/2 with those nearest to the truth, in cells of one
    surface near which one of them lies."""
    depth, farthest, known = surfaces_of_cells(truth, valid, 2)
    rows, columns = depth.shape[1:]
    step = torch.diff(found.log_planes, dim=1).mean(1)[:, None, None, None]
    away = (found.tried.detach()[..., :rows, :columns] - depth[:, None]).abs() / step
    known = known & (depth == farthest) & (away.amin(1) < 1)
    wanted = (-away / CHOICE).softmax(1)
    log = found.tried_logits[..., :rows, :columns].log_softmax(1)
    return _mean(-(wanted * log).sum(1), known)


def gradient_loss(error: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"]) -> Tensor:
    """Mean absolute differences of the errors of pixels 1, 2, 4, ... apart, over the scales."""
    total = error.new_zeros(())
    for level in range(SCALES):
        step = 2**level
        for x, known in ((error, valid), (error.mT, valid.mT)):
            difference = (x[..., step:] - x[..., :-step]).abs()
            total = total + _mean(difference, known[..., step:] & known[..., :-step])
    return total / SCALES


def plane_loss(
    logits: Float[Tensor, "b d h4 w4"],
    log_planes: Float[Tensor, "b d"],
    truth: Float[Tensor, "b h w"],
    valid: Bool[Tensor, "b h w"],
) -> Float[Tensor, ""]:
    """Cross-entropy of the planes with the two next to the truth, by their nearness; in a cell of
    two surfaces with those next to either."""
    nearest, farthest, known = surfaces_of_cells(truth, valid, 4)
    log = logits[..., : known.shape[1], : known.shape[2]].log_softmax(1)
    near, inside = _log_likelihood(log, log_planes, nearest)
    far, also = _log_likelihood(log, log_planes, farthest)
    either = torch.where(nearest == farthest, near, torch.logaddexp(near, far) - math.log(2))
    return _mean(-either, known & inside & also)


def _log_likelihood(
    log: Float[Tensor, "b d h w"], log_planes: Float[Tensor, "b d"], depth: Float[Tensor, "b h w"]
) -> tuple[Float[Tensor, "b h w"], Bool[Tensor, "b h w"]]:
    """Log-likelihood of depths, interpolated between planes, and a mask of those among them."""
    planes = log_planes.shape[1]
    step = plane_step(log_planes)[:, None, None]
    place = ((depth - log_planes[:, :1, None]) / step).nan_to_num(-1.0)
    below = place.floor().clamp(0, planes - 2)
    fraction = (place - below).clamp(0, 1)
    index = below.long()[:, None]
    between = (1 - fraction) * log.gather(1, index)[:, 0]
    between = between + fraction * log.gather(1, index + 1)[:, 0]
    return between, (place >= 0) & (place <= planes - 1)


def angular(angle: Tensor, concentration: Tensor) -> Tensor:
    """Negative log-likelihood of the angular von Mises-Fisher distribution (Bae et al., 2021), up
    to a constant: the density of an angle is proportional to (1 + k^2) exp(-k angle) over
    1 + exp(-k pi)."""
    k = concentration
    return k * angle - torch.log1p(k * k) + torch.log1p((-math.pi * k).exp())


def outlier_laplace(error: Tensor, log_scale: Tensor, outlier: Tensor, log_range: Tensor) -> Tensor:
    """Negative log-likelihood of errors: Laplace, or with the probability of an outlier uniform in
    the range."""
    inlier = -error.abs() * (-log_scale).exp() - log_scale - math.log(2)
    return -torch.logaddexp(
        functional.logsigmoid(-outlier) + inlier, functional.logsigmoid(outlier) - log_range.log()
    )


def _mean(values: Tensor, chosen: Tensor) -> Float[Tensor, ""]:
    """Mean of the chosen values; 0 if none is."""
    return torch.where(chosen, values, 0.0).sum() / chosen.sum().clamp_min(1)
