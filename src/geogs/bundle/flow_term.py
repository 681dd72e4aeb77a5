"""Term of dense flow: from matches to normal equations, source by source.

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

from geogs.bundle.hyper_edge import HyperEdge
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import CellProjection
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.geometry.robust import huber_weight

BEHIND = 10.0
"""Residual of a cell behind its target, in Huber thresholds. It has no gradient, but rejects steps
that move many cells there."""


@dataclass(frozen=True)
class SourceFlow:
    """Linearised edges of one source."""

    frame: int
    edges: HyperEdge
    """Edges, with equations of the source's depths."""
    diagonal: Float[Tensor, "c"] | None = None
    """Diagonal of the chained equations before any depth is eliminated, if requested."""


@runtime_checkable
class FlowTerm(Protocol):
    """Linearisation of the matches of a problem."""

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """Yield the linearised sources of all edges, in order."""
        ...

    def cost(self, problem: BundleProblem, state: BundleState, huber: float) -> float:
        """Return Huber's cost of all matched cells (twice the objective); one behind its target has
        a residual of ``BEHIND`` thresholds."""
        ...


def linearised_sources(
    flow: FlowTerm, problem: BundleProblem, state: BundleState, options: BundleOptions
) -> list[SourceFlow]:
    """Linearise all sources of a problem, with the other terms of their depths.

    Free depths are eliminated from the other equations.
    """
    found = []
    for source in flow.sources(problem, state, options):
        others = (term.of_frame(source.frame, state) for term in problem.depth_terms)
        edges = source.edges.with_depths(others)
        if bool(problem.free_depth[source.frame]):
            edges = edges.eliminated()
        found.append(replace(source, edges=edges))
    return found


def weighed_residuals(
    p: CellProjection, pixels: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"], huber: float
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """Return measured less projected positions r, and their weights, zero behind the target.

    W is multiplied by Huber's weight of |W^(1/2) r|.
    """
    r = pixels - p.pixels
    w = weight * p.valid[..., None]
    norm = (w * r.square()).sum(-1, keepdim=True).sqrt()
    return r, w * huber_weight(norm, huber)


def normal_equations(
    wJ: Float[Tensor, "e 6 2 p"], J: Float[Tensor, "e 6 2 p"], residual: Float[Tensor, "e p 2"]
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"]]:
    """Return J^T W J and J^T W r of every edge, summed over its cells."""
    left = wJ.flatten(2)
    right = torch.cat([J.flatten(2), residual.mT.flatten(1)[:, None]], 1)
    both = (left @ right.mT).double()
    return both[..., :6], both[..., 6]


def damped_curvature(curvature: Float[Tensor, "p"], fraction: float) -> Float[Tensor, "p"]:
    """Add a fraction of its mean to the curvature of a frame's inverse depths."""
    return curvature + fraction * curvature.mean() + 1e-8


def residual_norms(
    p: CellProjection, pixels: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
) -> Float[Tensor, "e p"]:
    """Return the norm of each residual in its own standard deviations."""
    return (weight * (pixels - p.pixels).square()).sum(-1).sqrt()
