"""What the depth network is trained by: depth, its deviation, normals, their concentration.

All of it is unit-free: depths are compared in their logarithms. Deviations, outliers and
concentrations learn from the likelihood of errors that are detached, so that hard pixels are not
given up.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from geogs.depth.network.plane_views import cell_rays
from geogs.depth.network.stereo_views import DepthPrediction
from geogs.depth.network.surface_normals import normals_of
from geogs_train.depth.depth_options import DepthLossOptions
from geogs_train.depth.depth_tuples import DepthBatch, has_truth

SMOOTH = 0.985
"""Cosine between true normals and those of true depth from which on a pixel is no edge."""
CELL_SPREAD = 0.05
"""Difference of log depth within a coarse cell from which on it has no one depth."""
SCALES = 4
"""Scales of differences, each twice as far apart."""


def depth_loss(
    found: DepthPrediction, batch: DepthBatch, options: DepthLossOptions
) -> Float[Tensor, ""]:
    """The sum of all parts."""
    valid = has_truth(batch)
    typical = batch.views.typical[:, None, None].expand_as(batch.depth)
    # A ray may meet nothing: what is not valid must be a number all the same.
    truth = (torch.where(valid, batch.depth, typical) / typical).log()
    error = found.log_depth - truth
    total = _mean(error.abs(), valid)
    for level, coarse in ((1, found.at_half), (2, found.at_quarter)):
        depth, known = coarse_truth(truth, valid, 2**level)
        coarse = coarse[:, : depth.shape[1], : depth.shape[2]]
        total = total + 2.0**-level * _mean((coarse - depth).abs(), known)
    total = total + options.gradient * gradient_loss(error, valid)

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
    # The angle's slope is infinite where it is zero.
    angle = (found.normal * batch.normal).sum(1).clamp(-1 + 1e-5, 1 - 1e-5).arccos()
    total = total + options.normal * _mean(angle, valid)
    spread = angular(angle.detach(), found.concentration)
    total = total + options.spread * late * _mean(spread, valid)
    log_range = (batch.views.far / batch.views.near).log()[:, None, None]
    likelihood = outlier_laplace(error.detach(), found.log_scale, found.outlier, log_range)
    return total + options.likelihood * late * _mean(likelihood, valid)


def coarse_truth(
    log_depth: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"], cell: int
) -> tuple[Float[Tensor, "b h2 w2"], Bool[Tensor, "b h2 w2"]]:
    """Mean of cells of ``cell`` x ``cell`` pixels, and which of them lie on one surface."""
    depth = log_depth[:, None]
    mean = functional.avg_pool2d(depth, cell)[:, 0]
    spread = functional.max_pool2d(depth, cell) + functional.max_pool2d(-depth, cell)
    known = -functional.max_pool2d(-valid[:, None].float(), cell)
    return mean, (spread[:, 0] < CELL_SPREAD) & (known[:, 0] > 0.5)


def gradient_loss(error: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"]) -> Tensor:
    """Differences of errors of pixels 1, 2, 4, ... apart: absolute, mean over the scales."""
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
    """Cross-entropy of the planes with the two beside the truth, by their nearness."""
    depth, known = coarse_truth(truth, valid, 4)
    first, planes = log_planes[:, :1, None], log_planes.shape[1]
    step = torch.diff(log_planes, dim=1).mean(1)[:, None, None]
    place = ((depth - first) / step).nan_to_num(-1.0)
    known = known & (place >= 0) & (place <= planes - 1)
    below = place.floor().clamp(0, planes - 2)
    fraction = (place - below).clamp(0, 1)
    log = logits[..., : depth.shape[1], : depth.shape[2]].log_softmax(1)
    index = below.long()[:, None]
    near = (1 - fraction) * log.gather(1, index)[:, 0] + fraction * log.gather(1, index + 1)[:, 0]
    return _mean(-near, known)


def angular(angle: Tensor, concentration: Tensor) -> Tensor:
    """Negative log-likelihood of the angular von Mises-Fisher distribution (Bae et al., 2021), up
    to a constant: the density of an angle is proportional to (1 + k^2) exp(-k angle) over
    1 + exp(-k pi)."""
    k = concentration
    return k * angle - torch.log1p(k * k) + torch.log1p((-math.pi * k).exp())


def outlier_laplace(error: Tensor, log_scale: Tensor, outlier: Tensor, log_range: Tensor) -> Tensor:
    """Negative log-likelihood of errors: Laplace, or with the probability of an outlier anything
    in the range."""
    inlier = -error.abs() * (-log_scale).exp() - log_scale - math.log(2)
    return -torch.logaddexp(
        functional.logsigmoid(-outlier) + inlier, functional.logsigmoid(outlier) - log_range.log()
    )


def _mean(values: Tensor, chosen: Tensor) -> Float[Tensor, ""]:
    """Over what is chosen; 0 of nothing."""
    return torch.where(chosen, values, 0.0).sum() / chosen.sum().clamp_min(1)
