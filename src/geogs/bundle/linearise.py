"""From matches to normal equations, source by source, their inverse depths eliminated.

Each edge is linearised in the motion of its target relative to its source, so only one Jacobian is
formed; the chain to both poses, ``xi_rel = xi_j - Ad(T_ji) xi_i``, is applied to the small reduced
blocks. Residuals and couplings are float32, the equations of poses float64.

A star is a source with its edges. Beside the relative motions it may have unknowns that all edges
share: they are its last rows and columns, and nothing here depends on what they are
(:mod:`geogs.bundle.blocks`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.base import BundleOptions
from geogs.bundle.measured_motions import MeasuredMotions
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.projection import Projection, linearise, relative_motion
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_adjoint


@dataclass(frozen=True)
class EliminatedDepth:
    """What brings the inverse depths of a source back after the step of all else."""

    coupling: Float[Tensor, "m p"]
    """sum w dp/du dp/dd, with the unknowns u of the star."""
    curvature: Float[Tensor, "p"]
    """sum w |dp/dd|^2 with all that resists a change."""
    gradient: Float[Tensor, "p"]
    """sum w r . dp/dd."""

    def step(self, unknowns: Float[Tensor, "m"]) -> Float[Tensor, "p"]:
        """Back-substitution: (b - E^T u) / C."""
        return (self.gradient - self.coupling.mT @ unknowns.to(self.coupling)) / self.curvature

    def reduce(
        self, hessian: Float[Tensor, "m m"], gradient: Float[Tensor, "m"]
    ) -> tuple[Float[Tensor, "m m"], Float[Tensor, "m"]]:
        """The equations of the star's unknowns without the depths: H - E C^-1 E^T, g - E C^-1 b."""
        E, C = self.coupling, self.curvature
        return (
            hessian - ((E / C) @ E.mT).to(hessian),
            gradient - (E @ (self.gradient / C)).to(gradient),
        )


@dataclass(frozen=True)
class Star:
    """A source frame with all its edges, linearised, its inverse depths eliminated if free."""

    frame: int
    targets: Int[Tensor, "k"]
    adjoint: Float[Tensor, "k 6 6"]
    """Of T_ji."""
    hessian: Float[Tensor, "m m"]
    """Over the relative motions of its k edges, then shared unknowns; float64."""
    gradient: Float[Tensor, "m"]
    information: Float[Tensor, "p"]
    """sum w |dp/dd|^2, and what was measured beside."""
    residual: Float[Tensor, "k"]
    """As in ``BundleResult``."""
    depth: EliminatedDepth | None
    """Of free inverse depths."""

    @property
    def poses(self) -> Int[Tensor, "k1"]:
        """The frames whose poses it joins: its targets and itself."""
        return torch.cat([self.targets, self.targets.new_tensor([self.frame])])

    @property
    def shared(self) -> int:
        """Number of unknowns that the edges share."""
        return len(self.gradient) - 6 * len(self.targets)

    @property
    def chain(self) -> Float[Tensor, "m c"]:
        """From steps of ``poses``, then of shared unknowns, to the star's own unknowns."""
        at = 6 * len(self.targets)
        eye = torch.eye(len(self.gradient), dtype=torch.float64, device=self.adjoint.device)
        source = torch.cat([-self.adjoint.flatten(0, 1), eye.new_zeros(self.shared, 6)])
        return torch.cat([eye[:, :at], source, eye[:, at:]], 1)

    def chained(self) -> tuple[Float[Tensor, "c c"], Float[Tensor, "c"]]:
        """Hessian and gradient over ``poses``, then shared unknowns."""
        chain = self.chain
        return chain.mT @ self.hessian @ chain, chain.mT @ self.gradient

    def pose_blocks(self) -> tuple[Float[Tensor, "k1 k1 6 6"], Float[Tensor, "k1 6"]]:
        """Hessian and gradient over ``poses`` in blocks, where nothing is shared."""
        hessian, gradient = self.chained()
        n = len(self.targets) + 1
        return hessian.reshape(n, 6, n, 6).transpose(1, 2), gradient.reshape(n, 6)


def motion_stars(motions: MeasuredMotions | None, T_cw: Float[Tensor, "n 4 4"]) -> list[Star]:
    """What measured motions say of the poses: stars of one edge each, without depths."""
    if motions is None:
        return []
    none, no_match = T_cw.new_zeros(0), T_cw.new_zeros(1)
    parts = (motions.source.tolist(), motions.target, *motions.equations(T_cw))
    return [
        Star(i, j[None], adjoint[None], hessian, gradient, none, no_match, None)
        for i, j, adjoint, hessian, gradient in zip(*parts, strict=True)
    ]


def weighed_residuals(
    p: Projection,
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    huber: float,
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """Measured less projected positions r, and their weights: none behind the target.

    W is multiplied by Huber's factor ``min(1, huber / |W^(1/2) r|)``.
    """
    r, w = pixels - p.pixels, weight * p.valid[..., None]
    norm = (w * r.square()).sum(-1, keepdim=True).sqrt()
    return r, w * (huber / norm.clamp(min=huber))


def normal_equations(
    wJ: Float[Tensor, "e 6 2 p"], J: Float[Tensor, "e 6 2 p"], residual: Float[Tensor, "e p 2"]
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"]]:
    """J^T W J and J^T W r of every edge, summed over its cells."""
    left = wJ.flatten(2)
    right = torch.cat([J.flatten(2), residual.mT.flatten(1)[:, None]], 1)
    both = (left @ right.mT).double()
    return both[..., :6], both[..., 6]


def edge_residual(
    residual: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
) -> Float[Tensor, "e"]:
    """Root of the weighted mean squared residual of each edge in pixels."""
    total = weight.sum((1, 2)).clamp(min=1e-12)
    return ((weight * residual.square()).sum((1, 2)) / total * 2).sqrt()


def damped_curvature(
    curvature: Float[Tensor, "p"], share: float, extra: Float[Tensor, "p"] | float = 0.0
) -> Float[Tensor, "p"]:
    """Curvature of a frame's inverse depths, a share of its mean, and what resists beside it."""
    return curvature + share * curvature.mean() + 1e-8 + extra


def linearise_stars(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    problem: BundleProblem,
    T: Float[Tensor, "n 4 4"],
    d: Float[Tensor, "n p"],
    options: BundleOptions,
    chunk: slice = slice(None),
) -> list[Star]:
    """The stars of some edges of a problem at the given poses and inverse depths."""
    i, j = problem.source[chunk], problem.target[chunk]
    T_ji = relative_motion(T, i, j)
    p = linearise(camera, rays, T_ji, d[i])
    r, w = weighed_residuals(p, problem.pixels[chunk], problem.weight[chunk], options.huber)
    wJ = p.pose_jacobian * w.mT[:, None]
    H, v = normal_equations(wJ, p.pose_jacobian, r)
    coupling = (wJ * p.depth_jacobian.mT[:, None]).sum(2)
    curvature = (w * p.depth_jacobian.square()).sum(-1)
    depth_gradient = (w * p.depth_jacobian * r).sum(-1)
    adjoint, residual = se3_adjoint(T_ji), edge_residual(r, w)
    stars = []
    for frame, e in sources_within(i):
        block, g, c = torch.block_diag(*H[e]), v[e].reshape(-1), curvature[e].sum(0)
        damped = damped_curvature(c, options.depth_damping, problem.damping_of(frame))
        b = depth_gradient[e].sum(0)
        if problem.measured is not None:
            curved, pull = problem.measured.pull(frame, d[frame])
            c, damped, b = c + curved, damped + curved, b + pull
        depth = None
        if bool(problem.free_depth[frame]):
            depth = EliminatedDepth(coupling[e].flatten(0, 1), damped, b)
            block, g = depth.reduce(block, g)
        stars.append(Star(frame, j[e], adjoint[e], block, g, c, residual[e], depth))
    return stars
