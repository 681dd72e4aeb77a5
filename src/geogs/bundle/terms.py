"""Terms of an adjustment: one for each kind of measurement.

To add a kind of measurement, write a term and add it where the problem is made
(``FrameGraph.streamed_problem``). A ``DepthTerm`` constrains single inverse depths, a ``PoseTerm``
poses. Dense flow, which every problem has, is :mod:`geogs.bundle.flow_term`.

CPU solvers accept any term; GPU solvers any pose term, and the depth terms for which they have a
kernel (:mod:`geogs.bundle.cuda.depth_terms`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.hyper_edge import DepthEquations, HyperEdge, RelativeEdges
from geogs.bundle.lens import LensBlock
from geogs.bundle.projection import relative_motion
from geogs.geometry.lie import se3_adjoint, se3_inverse, se3_left_jacobian, se3_log
from geogs.geometry.robust import cauchy_cost, cauchy_weight, huber_cost, huber_weight

MEASURED_HUBER = 3.0
"""Huber threshold of a measured depth, in deviations. That of matches is smaller: they are outliers
more often than sensor depths away from edges."""
KNEE = 3.0
"""Deviations (of all six numbers together) at which a motion counts half as much. Far beyond, the
influence falls with distance, so that outliers are out-voted."""


@dataclass(frozen=True)
class BundleState:
    """Present values of the unknowns."""

    T_cw: Float[Tensor, "n 4 4"]
    """World to camera of each frame, float64."""
    inverse_depth: Float[Tensor, "n p"]
    block: LensBlock | None = None
    """The lens, if it is adjusted, too."""


@runtime_checkable
class DepthTerm(Protocol):
    """Residuals of the inverse depths of single frames."""

    @property
    def information(self) -> Float[Tensor, "n p"] | None:
        """Inverse variances of its own measurements, if any."""
        ...

    def of_frame(self, frame: int, state: BundleState) -> DepthEquations:
        """Linearise the residuals of a frame."""
        ...

    def cost(self, state: BundleState) -> float:
        """Return the cost of all frames (twice the objective): robust squared residuals."""
        ...


@runtime_checkable
class PoseTerm(Protocol):
    """Residuals of poses, without depths; always on the CPU."""

    @property
    def source(self) -> Int[Tensor, "m"]:
        """Source frame of each residual."""
        ...

    @property
    def target(self) -> Int[Tensor, "m"]:
        """Target frame of each residual."""
        ...

    def hyper_edges(self, state: BundleState) -> Sequence[HyperEdge]:
        """Linearise the residuals."""
        ...

    def cost(self, state: BundleState) -> float:
        """Return the cost (twice the objective): robust squared residuals."""
        ...


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
