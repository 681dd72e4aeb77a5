"""Linearised residuals with common unknowns: the interface between terms and solvers.

A hyper-edge joins the poses of some frames, the inverse depths of one of them, and unknowns shared
by the whole problem, such as a lens. It may be linearised in unknowns of its own, such as the
relative motions of matches, with a chain to those of the problem. Depths are eliminated first,
frame by frame, since they are not coupled with each other. Equations of depths are float32, all
others float64.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import reduce

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class DepthEquations:
    """Normal equations of a frame's inverse depths, and their coupling with other unknowns."""

    coupling: Float[Tensor, "m p"]
    """sum w dr/du dr/dd, with the unknowns u of the hyper-edge."""
    curvature: Float[Tensor, "p"]
    """sum w |dr/dd|^2, plus damping."""
    gradient: Float[Tensor, "p"]
    """-sum w r . dr/dd, the direction of descent."""
    information: Float[Tensor, "p"]
    """The part of the curvature that is measured, without damping."""

    @staticmethod
    def alone(
        curvature: Float[Tensor, "p"],
        gradient: Float[Tensor, "p"] | None = None,
        information: Float[Tensor, "p"] | None = None,
    ) -> "DepthEquations":
        """Return equations of depths without coupling; omitted parts are zero."""
        none = curvature.new_zeros(0, len(curvature))
        zero = torch.zeros_like(curvature)
        return DepthEquations(
            none,
            curvature,
            zero if gradient is None else gradient,
            zero if information is None else information,
        )

    def plus(self, other: "DepthEquations") -> "DepthEquations":
        """Return the sum, where the other has no coupling."""
        return DepthEquations(
            self.coupling,
            self.curvature + other.curvature,
            self.gradient + other.gradient,
            self.information + other.information,
        )

    def on_cells(self, cells: slice) -> "DepthEquations":
        """Return the equations of some of the cells, on the CPU."""
        parts = (self.coupling, self.curvature, self.gradient, self.information)
        return DepthEquations(*(part[..., cells].cpu() for part in parts))

    def after(self, unknowns: Float[Tensor, "m"]) -> "DepthEquations":
        """Return the equations of the depths alone after a step of all others: b - E^T u."""
        left = self.gradient - self.coupling.mT @ unknowns.to(self.coupling)
        return DepthEquations.alone(self.curvature, left, self.information)

    @property
    def solution(self) -> Float[Tensor, "p"]:
        """Step of depths without coupling."""
        return self.gradient / self.curvature

    def reduce(
        self, hessian: Float[Tensor, "m m"], gradient: Float[Tensor, "m"]
    ) -> tuple[Float[Tensor, "m m"], Float[Tensor, "m"]]:
        """Eliminate the depths from the other equations: H - E C^-1 E^T, g - E C^-1 b."""
        E = self.coupling
        C = self.curvature
        return (
            hessian - ((E / C) @ E.mT).to(hessian),
            gradient - (E @ (self.gradient / C)).to(gradient),
        )


@dataclass(frozen=True)
class HyperEdge:
    """Residuals linearised directly in the steps of the poses and of the shared unknowns."""

    poses: Int[Tensor, "k"]
    """Frames whose poses it joins."""
    hessian: Float[Tensor, "m m"]
    gradient: Float[Tensor, "m"]
    """Direction of descent."""
    shared: int = 0
    """Number of the problem's shared unknowns, if it has them; they come last."""
    depth: DepthEquations = field(default_factory=lambda: DepthEquations.alone(torch.zeros(0)))
    """Equations of the inverse depths of one frame; by default of none."""

    @property
    def chain(self) -> Float[Tensor, "m c"]:
        """Matrix from steps of ``poses``, then of shared unknowns, to its own unknowns."""
        return torch.eye(len(self.gradient), dtype=self.gradient.dtype)

    def rows(self, frames: int) -> Int[Tensor, "c"]:
        """Return the indices of ``poses``, then of shared unknowns, among those of a problem."""
        poses = (6 * self.poses[:, None] + torch.arange(6)).reshape(-1)
        return torch.cat([poses, 6 * frames + torch.arange(self.shared)])

    def chained(self) -> tuple[Float[Tensor, "c c"], Float[Tensor, "c"]]:
        """Return Hessian and gradient over ``poses``, then shared unknowns."""
        chain = self.chain
        return chain.mT @ self.hessian @ chain, chain.mT @ self.gradient

    def pose_blocks(self) -> tuple[Float[Tensor, "k k 6 6"], Float[Tensor, "k 6"]]:
        """Return Hessian and gradient over ``poses`` in blocks, without shared unknowns."""
        hessian, gradient = self.chained()
        n = len(self.poses)
        return hessian.reshape(n, 6, n, 6).transpose(1, 2), gradient.reshape(n, 6)

    def chained_coupling(self) -> Float[Tensor, "c p"]:
        """Return the coupling of the depths with ``poses``, then shared unknowns."""
        return self.chain.mT.to(self.depth.coupling) @ self.depth.coupling

    def depth_after(self, step: Float[Tensor, "v"], frames: int) -> DepthEquations:
        """Return equations of its depths after a step of all poses and shared unknowns."""
        depth = replace(self.depth, coupling=self.chained_coupling())
        return depth.after(step[self.rows(frames)])

    def with_depths(self, others: Iterable[DepthEquations]) -> "HyperEdge":
        """Return it with other equations of the same depths added."""
        return replace(self, depth=reduce(DepthEquations.plus, others, self.depth))

    def eliminated(self) -> "HyperEdge":
        """Return it with the depths eliminated from the other equations."""
        hessian, gradient = self.depth.reduce(self.hessian, self.gradient)
        return replace(self, hessian=hessian, gradient=gradient)

    def of_poses(self) -> "HyperEdge":
        """Return it without the shared unknowns."""
        size = len(self.gradient) - self.shared
        return replace(
            self,
            hessian=self.hessian[:size, :size],
            gradient=self.gradient[:size],
            shared=0,
            depth=replace(self.depth, coupling=self.depth.coupling[:size]),
        )

    def without_coupling(self) -> "HyperEdge":
        """Return it without the coupling, which is large and only needed for the depths."""
        none = self.depth.coupling.new_zeros(0, len(self.depth.curvature))
        return replace(self, depth=replace(self.depth, coupling=none))


@dataclass(frozen=True, kw_only=True)
class RelativeEdges(HyperEdge):
    """Edges from a source to its targets, linearised in the motions of the targets relative to it.

    Only one Jacobian is formed; the chain to both poses is ``xi_rel = xi_j - Ad(T_ji) xi_i``. The
    source is the last of the poses; there may also be shared unknowns.
    """

    adjoint: Float[Tensor, "e 6 6"]
    """Adjoint of the motion T_ji of each edge."""

    @property
    def chain(self) -> Float[Tensor, "m c"]:
        """Matrix from steps of all poses, the source's last, then of shared unknowns."""
        at = 6 * len(self.adjoint)
        eye = torch.eye(len(self.gradient), dtype=torch.float64, device=self.adjoint.device)
        source = torch.cat([-self.adjoint.flatten(0, 1), eye.new_zeros(self.shared, 6)])
        return torch.cat([eye[:, :at], source, eye[:, at:]], 1)

    def depth_after(self, step: Float[Tensor, "v"], frames: int) -> DepthEquations:
        """Return equations of the source's depths, by the relative motions alone."""
        if self.shared:
            return super().depth_after(step, frames)
        xi = step[: 6 * frames].reshape(frames, 6)
        relative = xi[self.poses[:-1]] - self.adjoint @ xi[self.poses[-1]]
        return self.depth.after(relative.reshape(-1))
