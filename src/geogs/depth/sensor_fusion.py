"""Fusion of a keyframe's searched depth with that of a sensor."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.depth.depth_view import DenseDepth

TOLERANCE = 0.02
"""Relative error below which a depth is right: confidences are the chance of that."""
MIN_DEVIATION = 0.02
"""Least relative deviation of a searched depth where there is a measured one."""
MAX_DIFFERENCE = 3.0
"""Standard deviations of the difference beyond which the searched depth is an outlier."""
MAX_CONFIDENCE = 0.98
"""Largest confidence of a measured depth."""


def fused_with_sensor(
    searched: DenseDepth,
    inverse_depth: Float[Tensor, "h w"],
    information: Float[Tensor, "h w"],
) -> DenseDepth:
    """Mean of the searched and the measured depth, weighted by their inverse variances.

    Where they do not agree, the measured depth; where nothing was measured, the searched one. The
    measurement is an inverse depth, per map unit, and its information 1 / sigma^2, 0 for none.
    """
    known = information > 0
    measured = torch.where(known, 1 / inverse_depth.clamp(min=1e-12), searched.depth)
    own = torch.where(known, measured / information.clamp(min=1e-12).sqrt(), 1.0)
    chance = searched.confidence.clamp(1e-3, 1 - 1e-3)
    theirs = (TOLERANCE / (math.sqrt(2) * torch.erfinv(chance))).clamp(min=MIN_DEVIATION)
    step = searched.depth / measured - 1
    agree = step.abs() < MAX_DIFFERENCE * torch.hypot(own, theirs)
    fraction = torch.where(known & agree, own.square() / (own.square() + theirs.square()), 0.0)
    depth = torch.where(known, measured * (1 + fraction * step), searched.depth)
    deviation = own * (1 - fraction).sqrt()
    right = torch.erf(TOLERANCE / (math.sqrt(2) * deviation)).clamp(max=MAX_CONFIDENCE)
    confidence = torch.where(known, right, searched.confidence)
    median = depth.median().cpu()
    return replace(searched, depth=depth, confidence=confidence, median=median, written=None)
