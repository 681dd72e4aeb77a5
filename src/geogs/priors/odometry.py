"""Motions measured by another tracker: their noise, and the scale of the images' motions."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import OdometryConfig
from geogs.geometry.lie import se3_inverse, so3_log

ROTATION_DEG = 0.15
"""Deviation of an orientation from one keyframe to the next, however near."""
FIT = 16.8
"""Largest squared normalised difference (six degrees of freedom) of motions that fit: 99 %."""
PROPOSALS = 256
"""Most scales that are tried, evenly chosen along the path."""


@dataclass(frozen=True)
class ScaleVote:
    """Scale between motions of the images and measured ones."""

    scale: float
    """Metres per unit of the images' motions."""
    deviation: float
    """Relative standard deviation of the scale; infinite where it is unknown."""
    fits: Bool[Tensor, "m"]
    """Whether each motion fits at that scale."""

    @property
    def fraction(self) -> float:
        """Fraction of the motions that fit."""
        return float(self.fits.double().mean()) if len(self.fits) else 0.0


def information_of(motion: Float[Tensor, "m 4 4"], config: OdometryConfig) -> Float[Tensor, "m 6"]:
    """Inverse variances of translation (metres) and rotation (radians) of measured motions."""
    distance = motion[:, :3, 3].norm(dim=1, keepdim=True)
    translation = config.deviation**2 + (config.drift * distance) ** 2
    rotation = math.radians(1) ** 2 * (ROTATION_DEG**2 + (config.rotation_drift * distance) ** 2)
    return torch.cat([1 / translation.expand(-1, 3), 1 / rotation.expand(-1, 3)], 1)


def vote_on_scale(
    seen: Float[Tensor, "m 4 4"], measured: Float[Tensor, "m 4 4"], config: OdometryConfig
) -> ScaleVote:
    """The scale at which most motions seen in the images fit those that were measured in metres.

    Each pair proposes the ratio of its lengths; the proposal with the highest sum of Cauchy's
    weights is refined by reweighted least squares. The problem is linear in the scale, so each
    round solves it directly, without the general least-squares loop. Rotations have to fit, too.
    """
    information = information_of(measured, config)
    rotation_error = so3_log(measured[:, :3, :3].mT @ seen[:, :3, :3])
    rotation = (information[:, 3:] * rotation_error.square()).sum(1)
    # Positions of the targets in the sources: rotations must not count twice.
    t, t_measured = se3_inverse(seen)[:, :3, 3], se3_inverse(measured)[:, :3, 3]
    precision = information[:, 0]

    def misfit(scale: Float[Tensor, "*s"]) -> Float[Tensor, "*s m"]:
        difference = scale[..., None, None] * t - t_measured
        return rotation + precision * difference.square().sum(-1)

    lengths = t.norm(dim=1)
    moved = lengths > 0
    proposals = t_measured.norm(dim=1)[moved] / lengths[moved]
    proposals = proposals[:: 1 + len(proposals) // PROPOSALS]
    if not len(proposals):
        return ScaleVote(1.0, math.inf, torch.zeros(len(t), dtype=torch.bool))
    support = (1 / (1 + misfit(proposals) / FIT)).sum(1)
    scale = proposals[support.argmax()]
    for _ in range(10):
        weight = precision / (1 + misfit(scale) / FIT) ** 2
        scale = (weight * (t * t_measured).sum(1)).sum() / (weight * lengths.square()).sum()
    fits = misfit(scale) <= FIT
    known = float((precision * lengths.square())[fits].sum())
    deviation = 1 / (float(scale) * math.sqrt(known)) if known > 0 and scale > 0 else math.inf
    return ScaleVote(float(scale), deviation, fits)
