"""Calibration of the network's deviations and confidences."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

TOLERANCE = 0.02
"""Relative error of depth up to which it counts as right, as for the classical search."""


@dataclass(frozen=True)
class DepthCalibration:
    """Parameters fitted on rooms that were not in the training."""

    scale: float = 1.0
    """Factor on Laplace scales."""
    gain: float = 1.0
    """Factor on the logit of the chance that a depth is right."""
    offset: float = 0.0
    """Added to that logit."""

    def deviation(self, log_scale: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Standard deviation of log depth of inliers."""
        return 2**0.5 * self.scale * log_scale.exp()

    def confidence(
        self, log_scale: Float[Tensor, "*n"], outlier: Float[Tensor, "*n"]
    ) -> Float[Tensor, "*n"]:
        """Chance that depth is right to ``TOLERANCE``."""
        return (self.gain * right_logit(log_scale, outlier) + self.offset).sigmoid()


def right_logit(
    log_scale: Float[Tensor, "*n"], outlier: Float[Tensor, "*n"]
) -> Float[Tensor, "*n"]:
    """Logit of the chance, by the network's distribution, that a depth is right."""
    inside = 1 - (-TOLERANCE * (-log_scale).exp()).exp()
    return torch.logit((-outlier).sigmoid() * inside, 1e-4)
