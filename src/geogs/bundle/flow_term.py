"""The term of dense flow: from matches to normal equations, source by source.

Each edge is linearised in the motion of its target relative to its source
(:class:`~geogs.bundle.hyper_edge.RelativeEdges`). Residuals and couplings are float32, the
equations of poses float64.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.hyper_edge import DepthEquations, HyperEdge, RelativeEdges
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.projection import CellProjection, linearise, project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_adjoint
from geogs.geometry.robust import huber_cost, huber_weight

BEHIND = 10.0
"""By how many of Huber's knees a cell counts as off whose target sees it from behind. No step is
drawn by that, and none is taken that brings many there."""


@dataclass(frozen=True)
class SourceFlow:
    """The edges of one source, linearised."""

    frame: int
    edges: HyperEdge
    """With equations of the source's depths."""
    diagonal: Float[Tensor, "c"] | None = None
    """Diagonal of the chained equations before any depth is eliminated, where it is asked for."""

    @property
    def information(self) -> Float[Tensor, "p"]:
        """Information of the source's inverse depths."""
        assert self.edges.depth is not None
        return self.edges.depth.information


@runtime_checkable
class FlowTerm(Protocol):
    """How the matches of a problem are linearised."""

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """The sources of all edges, in order."""
        ...

    def cost(self, problem: BundleProblem, state: BundleState, huber: float) -> float:
        """Twice what is minimised: :func:`matched_cost` of all edges."""
        ...


class PinholeFlow:
    """Dense flow of a pinhole camera that is known."""

    def __init__(self, camera: Camera, rays: Float[Tensor, "p 3"]) -> None:
        self.camera, self.rays = camera, rays

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """As in the protocol."""
        i, j = problem.source, problem.target
        T_ji = relative_motion(state.T_cw, i, j)
        p = linearise(self.camera, self.rays, T_ji, state.inverse_depth[i])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, options.huber)
        wJ = p.pose_jacobian * w.mT[:, None]
        H, v = normal_equations(wJ, p.pose_jacobian, r)
        coupling = (wJ * p.depth_jacobian.mT[:, None]).sum(2)
        curvature = (w * p.depth_jacobian.square()).sum(-1)
        depth_gradient = (w * p.depth_jacobian * r).sum(-1)
        adjoint = se3_adjoint(T_ji)
        for frame, e in sources_within(i):
            c = curvature[e].sum(0)
            depth = DepthEquations(
                coupling[e].flatten(0, 1),
                damped_curvature(c, options.depth_damping),
                depth_gradient[e].sum(0),
                c,
            )
            poses = torch.cat([j[e], j.new_tensor([frame])])
            block, g = torch.block_diag(*H[e]), v[e].reshape(-1)
            edges = RelativeEdges(poses, block, g, depth=depth, adjoint=adjoint[e])
            yield SourceFlow(frame, edges)

    def cost(self, problem: BundleProblem, state: BundleState, huber: float) -> float:
        """As in the protocol."""
        i = problem.source
        T_ji = relative_motion(state.T_cw, i, problem.target)
        p = project(self.camera, self.rays, T_ji, state.inverse_depth[i])
        return matched_cost(p, problem.pixels, problem.weight, huber)

    def depths_after(
        self,
        problem: BundleProblem,
        state: BundleState,
        xi: Float[Tensor, "n 6"],
        options: BundleOptions,
    ) -> Iterator[tuple[int, DepthEquations]]:
        """Equations of the depths of each source after a step of the poses.

        The matches are linearised once more: sum_e w dp/dd (r - dp/dxi xi_rel).
        """
        i, j = problem.source, problem.target
        T_ji = relative_motion(state.T_cw, i, j)
        p = linearise(self.camera, self.rays, T_ji, state.inverse_depth[i])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, options.huber)
        relative = (xi[j] - (se3_adjoint(T_ji) @ xi[i][..., None])[..., 0]).to(r)
        moved = (p.pose_jacobian * relative[:, :, None, None]).sum(1).mT
        curvature = (w * p.depth_jacobian.square()).sum(-1)
        gradient = (w * p.depth_jacobian * (r - moved)).sum(-1)
        for frame, e in sources_within(i):
            damped = damped_curvature(curvature[e].sum(0), options.depth_damping)
            yield frame, DepthEquations.alone(damped, gradient[e].sum(0))


def linearised_sources(
    flow: FlowTerm, problem: BundleProblem, state: BundleState, options: BundleOptions
) -> list[SourceFlow]:
    """All sources of a problem, joined with the other terms of their depths.

    Depths that are free are eliminated from the equations of all else.
    """
    found = []
    for source in flow.sources(problem, state, options):
        edges = source.edges
        for term in problem.depth_terms:
            edges = edges.joined(term.of_frame(source.frame, state))
        if bool(problem.free_depth[source.frame]):
            edges = edges.eliminated()
        found.append(replace(source, edges=edges))
    return found


def weighed_residuals(
    p: CellProjection,
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    huber: float,
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """Measured less projected positions r, and their weights: none behind the target.

    W is multiplied by Huber's weight of |W^(1/2) r|.
    """
    r, w = pixels - p.pixels, weight * p.valid[..., None]
    norm = (w * r.square()).sum(-1, keepdim=True).sqrt()
    return r, w * huber_weight(norm, huber)


def normal_equations(
    wJ: Float[Tensor, "e 6 2 p"], J: Float[Tensor, "e 6 2 p"], residual: Float[Tensor, "e p 2"]
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"]]:
    """J^T W J and J^T W r of every edge, summed over its cells."""
    left = wJ.flatten(2)
    right = torch.cat([J.flatten(2), residual.mT.flatten(1)[:, None]], 1)
    both = (left @ right.mT).double()
    return both[..., :6], both[..., 6]


def damped_curvature(curvature: Float[Tensor, "p"], fraction: float) -> Float[Tensor, "p"]:
    """Curvature of a frame's inverse depths, and a fraction of its mean."""
    return curvature + fraction * curvature.mean() + 1e-8


def residual_norms(
    p: CellProjection, pixels: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
) -> Float[Tensor, "e p"]:
    """Norm of each residual in its own standard deviations."""
    return (weight * (pixels - p.pixels).square()).sum(-1).sqrt()


def matched_cost(
    p: CellProjection, pixels: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"], huber: float
) -> float:
    """Huber's cost of all matched cells; one behind its target is ``BEHIND`` hubers off."""
    x, y = (weight * (pixels - p.pixels).square()).unbind(-1)
    cost = huber_cost(torch.where(p.valid, x + y, (BEHIND * huber) ** 2), huber)
    return float(torch.where(weight[..., 0] > 0, cost, 0.0).sum(dtype=torch.float64))
