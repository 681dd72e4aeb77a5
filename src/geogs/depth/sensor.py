"""A keyframe's searched depth and what a sensor measured of it, made one."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.depth.depth_view import DenseDepth

RIGHT = 0.02
"""Relative error of a depth that is called right: what confidences are the chance of."""
SEARCHED = 0.02
"""Relative deviation of a searched depth, at best, beside a measured one."""
OUTVOTED = 3.0
"""Deviations by which the two differ where the searched depth is left."""
SUREST = 0.98
"""Confidence that no measured depth exceeds."""


def joined(
    searched: DenseDepth,
    inverse_depth: Float[Tensor, "h w"],
    information: Float[Tensor, "h w"],
) -> DenseDepth:
    """The searched depth with the measured one: their mean by variances where they agree.

    Where they do not, the measured one; where nothing was measured, the searched one. The measured
    one is an inverse depth in the lengths of the map with its information 1 / sigma^2, 0 where
    there is none.
    """
    known = information > 0
    measured = torch.where(known, 1 / inverse_depth.clamp(min=1e-12), searched.depth)
    own = torch.where(known, measured / information.clamp(min=1e-12).sqrt(), 1.0)
    chance = searched.confidence.clamp(1e-3, 1 - 1e-3)
    theirs = (RIGHT / (math.sqrt(2) * torch.erfinv(chance))).clamp(min=SEARCHED)
    step = searched.depth / measured - 1
    agree = step.abs() < OUTVOTED * torch.hypot(own, theirs)
    fraction = torch.where(known & agree, own.square() / (own.square() + theirs.square()), 0.0)
    depth = torch.where(known, measured * (1 + fraction * step), searched.depth)
    deviation = own * (1 - fraction).sqrt()
    right = torch.erf(RIGHT / (math.sqrt(2) * deviation)).clamp(max=SUREST)
    confidence = torch.where(known, right, searched.confidence)
    median = depth.median().cpu()
    return replace(searched, depth=depth, confidence=confidence, median=median, written=None)
