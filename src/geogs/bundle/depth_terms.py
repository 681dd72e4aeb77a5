"""Terms of single inverse depths: damping, and sensor depths."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.hyper_edge import DepthEquations
from geogs.bundle.terms import BundleState
from geogs.geometry.robust import huber_cost, huber_weight

MEASURED_HUBER = 3.0
"""Huber threshold of a measured depth, in deviations. That of matches is smaller: they are outliers
more often than sensor depths away from edges."""


@dataclass(frozen=True)
class DepthDamping:
    """Damping of each inverse depth, without any measurement: DROID-SLAM's eta."""

    curvature: Float[Tensor, "n p"]
    """Curvature added to that of the matches, sum_e w |dp/dd|^2."""
    information: ClassVar[None] = None
    """None: nothing is measured."""

    def of_frame(self, frame: int, state: BundleState) -> DepthEquations:
        return DepthEquations.alone(self.curvature[frame])

    def cost(self, state: BundleState) -> float:
        """Return zero: it damps each step, wherever it begins."""
        return 0.0


@dataclass(frozen=True)
class MeasuredDepths:
    """Inverse depths measured independently of the matches; Huber cost."""

    inverse_depth: Float[Tensor, "n p"]
    information: Float[Tensor, "n p"]
    """Inverse variances; 0 where nothing was measured."""

    def of_frame(self, frame: int, state: BundleState) -> DepthEquations:
        """Return a and a (measured - d), where a is the information times Huber's weight."""
        information = self.information[frame]
        residual = self.inverse_depth[frame] - state.inverse_depth[frame]
        norm = information.sqrt() * residual.abs()
        curvature = information * huber_weight(norm, MEASURED_HUBER)
        return DepthEquations.alone(curvature, curvature * residual, curvature)

    def cost(self, state: BundleState) -> float:
        square = self.information * (self.inverse_depth - state.inverse_depth).square()
        return float(huber_cost(square, MEASURED_HUBER).sum(dtype=torch.float64))
