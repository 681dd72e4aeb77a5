"""Term of motions between frames measured by another source than the images."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.hyper_edge import HyperEdge, RelativeEdges
from geogs.bundle.projection import relative_motion
from geogs.bundle.terms import BundleState
from geogs.geometry.lie import se3_adjoint, se3_inverse, se3_left_jacobian, se3_log
from geogs.geometry.robust import cauchy_cost, cauchy_weight

KNEE = 3.0
"""Deviations (of all six numbers together) at which a motion counts half as much. Far beyond, the
influence falls with distance, so that outliers are out-voted."""


@dataclass(frozen=True)
class MeasuredMotions:
    """Motions between pairs of frames, in the lengths of the map; robust by Cauchy's loss."""

    source: Int[Tensor, "m"]
    target: Int[Tensor, "m"]
    T_ts: Float[Tensor, "m 4 4"]
    """Camera of the source to that of the target, float64."""
    information: Float[Tensor, "m 6"]
    """Inverse variances of translation and rotation (radians), in the target's axes."""

    def residual(self, T_cw: Float[Tensor, "n 4 4"]) -> Float[Tensor, "m 6"]:
        """Return the difference of present and measured motions: Log(T_t T_s^-1 T_ts^-1)."""
        present = relative_motion(T_cw, self.source, self.target)
        return se3_log(present @ se3_inverse(self.T_ts))

    def robust_weight(self, residual: Float[Tensor, "m 6"]) -> Float[Tensor, "m"]:
        """Return the Cauchy weight of each motion, with scale ``KNEE`` deviations."""
        return cauchy_weight((self.information * residual.square()).sum(-1) / KNEE**2)

    def equations(
        self, T_cw: Float[Tensor, "n 4 4"]
    ) -> tuple[Float[Tensor, "m 6 6"], Float[Tensor, "m 6 6"], Float[Tensor, "m 6"]]:
        """Return adjoints of the present motions; Hessian and gradient of a step of each.

        A step ``xi_rel = xi_t - Ad(T_ts) xi_s`` of the motion changes the residual e by
        ``Jl(e)^-1 xi_rel``.
        """
        present = relative_motion(T_cw, self.source, self.target)
        e = self.residual(T_cw)
        J = torch.linalg.inv(se3_left_jacobian(e))
        JW = J.mT * (self.robust_weight(e)[:, None] * self.information)[:, None]
        return se3_adjoint(present), JW @ J, -(JW @ e[..., None])[..., 0]

    def cost(self, state: BundleState) -> float:
        square = (self.information * self.residual(state.T_cw).square()).sum(-1)
        return float(KNEE**2 * cauchy_cost(square / KNEE**2).sum())

    def hyper_edges(self, state: BundleState) -> list[HyperEdge]:
        """Return one hyper-edge for each motion."""
        ends = torch.stack([self.target, self.source], 1)
        parts = (ends, *self.equations(state.T_cw))
        return [
            RelativeEdges(poses, hessian, gradient, adjoint=adjoint[None])
            for poses, adjoint, hessian, gradient in zip(*parts, strict=True)
        ]
