"""Dense matches between keyframes in a Sim(3) pose graph, their inverse depth eliminated.

A keyframe's similarity S takes the world to its camera in the keyframe's own unit of length. A
cell of keyframe i with ray X and inverse depth d lies at Y = s R X + d t in keyframe j, with
``(s R, t) = S_j S_i^-1``, and is seen at pi(K Y). Projection ignores scale, so an edge is
linearised in the six numbers [tau, phi] of the relative similarity; the chain to both keyframes,
``xi_rel = xi_j - Ad(S_ji) xi_i``, includes the scale of the source.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.hyper_edge import DepthEquations
from geogs.bundle.problem import source_chunks, sources_within
from geogs.bundle.projection import linearise, project
from geogs.geometry.camera import Camera
from geogs.geometry.lie import sim3_adjoint, sim3_inverse
from geogs.geometry.robust import huber_cost
from geogs.loop.block_system import BlockEquations

HUBER = 3.0
"""Huber threshold in standard deviations."""
FACTOR = 1e-3
"""Factor on the cost. Errors of an edge's cells are correlated, so that an edge of a thousand cells
has little more information than one of them; relative poses are weighted in the same way."""
DEPTH_DAMPING = 1e-3
"""Damping of inverse depth relative to the mean curvature of its keyframe."""
CHUNK = 24
"""Edges linearised at a time; bounds memory."""


@dataclass(frozen=True)
class GraphState:
    """Present values of a pose graph's unknowns; always on the CPU."""

    S: Float[Tensor, "n 4 4"]
    """World to camera in each keyframe's own unit of length, float64."""
    inverse_depth: Float[Tensor, "n p"] | None = None
    """Inverse depth in the keyframe's unit; None without matches."""


def relative_similarity(
    S: Float[Tensor, "n 4 4"], source: Int[Tensor, "e"], target: Int[Tensor, "e"]
) -> Float[Tensor, "e 4 4"]:
    """Return S_ji = S_j S_i^-1 of every edge i -> j."""
    return S[target] @ sim3_inverse(S[source])


@dataclass(frozen=True)
class MatchedEdges:
    """Directed edges with a measured position in the target for every cell of the source."""

    camera: Camera
    rays: Float[Tensor, "p 3"]
    """K^-1 (x, y, 1) of each cell."""
    inverse_depth: Float[Tensor, "n p"]
    """Inverse depth of every keyframe of the graph, in its own unit of length."""
    source: Int[Tensor, "e"]
    """Index of a keyframe; ascending."""
    target: Int[Tensor, "e"]
    pixels: Float[Tensor, "e p 2"]
    """Positions of the source's cells in the target."""
    weight: Float[Tensor, "e p 2"]
    """Inverse variance of x and y, 1 / pixel^2; 0 where nothing was matched."""

    def linearise(self, state: GraphState) -> "LinearMatches":
        """Linearise the edges at a state with inverse depths."""
        d = state.inverse_depth
        assert d is not None
        sources: list[LinearSource] = []
        valid = [torch.zeros(0, self.weight.shape[1], dtype=torch.bool)]
        for chunk in source_chunks(self.source, CHUNK):
            i, j = self.source[chunk], self.target[chunk]
            S_ji = relative_similarity(state.S, i, j)
            p = linearise(self.camera, self.rays, S_ji, d[i])
            valid.append(p.valid)
            r, w = weighed_residuals(p, self.pixels[chunk], self.weight[chunk], HUBER)
            w = FACTOR * w
            J = p.pose_jacobian
            D = p.depth_jacobian
            wJ = J * w.mT[:, None]
            H = (wJ.flatten(2) @ J.flatten(2).mT).double()
            v = (wJ.flatten(2) @ r.mT.flatten(1)[..., None])[..., 0].double()
            coupling = (wJ * D.mT[:, None]).sum(2)
            curvature = (w * D.square()).sum(-1)
            b = (w * D * r).sum(-1)
            adjoint = sim3_adjoint(S_ji)[:, :6]
            for frame, e in sources_within(i):
                c = curvature[e].sum(0)
                depth = DepthEquations(coupling[e].flatten(0, 1), c, b[e].sum(0), c)
                sources.append(LinearSource(frame, j[e], adjoint[e], H[e], v[e], depth))
        return LinearMatches(self, len(state.S), sources, torch.cat(valid))


@dataclass(frozen=True)
class LinearSource:
    """A source with its edges, linearised in their relative similarities."""

    source: int
    targets: Int[Tensor, "k"]
    adjoint: Float[Tensor, "k 6 7"]
    """First six rows of Ad(S_ji)."""
    hessian: Float[Tensor, "k 6 6"]
    gradient: Float[Tensor, "k 6"]
    depth: DepthEquations
    """Undamped equations of the source's depths."""

    def damped_depth(self, damping: float) -> DepthEquations:
        """Return the damped equations of the depths."""
        c = self.depth.curvature
        return replace(self.depth, curvature=c * (1 + damping) + DEPTH_DAMPING * c.mean() + 1e-12)

    def reduced(
        self, depth: DepthEquations
    ) -> tuple[Int[Tensor, "m"], Float[Tensor, "m m 7 7"], Float[Tensor, "m 7"]]:
        """Eliminate its depths; return indices, blocks and gradient over its keyframes."""
        k = len(self.targets)
        block, g = depth.reduce(torch.block_diag(*self.hessian), self.gradient.reshape(-1))
        target = torch.eye(6, 7, dtype=torch.float64)
        chain = torch.cat([torch.block_diag(*[target] * k), -self.adjoint.reshape(6 * k, 7)], 1)
        at = torch.cat([self.targets, self.targets.new_tensor([self.source])])
        full = (chain.mT @ block @ chain).reshape(k + 1, 7, k + 1, 7).transpose(1, 2)
        return at, full, (chain.mT @ g).reshape(k + 1, 7)


@dataclass(frozen=True)
class LinearMatches:
    """All matched edges at one state."""

    edges: MatchedEdges
    keyframes: int
    sources: list[LinearSource]
    valid: Bool[Tensor, "e p"]
    """Cells in front of their target; only these count."""

    def equations(self, damping: float) -> BlockEquations:
        """Return equations over the keyframes; depths are damped by their curvature, too."""
        index = torch.zeros(0, dtype=torch.long)
        gradient = torch.zeros(self.keyframes, 7, dtype=torch.float64)
        rows = [index]
        columns = [index]
        blocks = [gradient.new_zeros(0, 7, 7)]
        for source in self.sources:
            depth = source.damped_depth(damping)
            at, block, g = source.reduced(depth)
            gradient.index_add_(0, at, g)
            rows.append(at.repeat_interleave(len(at)))
            columns.append(at.repeat(len(at)))
            blocks.append(block.flatten(0, 1))
        return BlockEquations(torch.cat(rows), torch.cat(columns), torch.cat(blocks), gradient)

    def cost(self, state: GraphState) -> float:
        """Return Huber's cost; cells now behind their target are clamped to its front.

        The set of cells is fixed, so that a step cannot lower the cost by losing some from view.
        """
        edges = self.edges
        d = state.inverse_depth
        assert d is not None
        total = 0.0
        for start in range(0, len(edges.source), CHUNK):
            chunk = slice(start, start + CHUNK)
            i, j = edges.source[chunk], edges.target[chunk]
            p = project(edges.camera, edges.rays, relative_similarity(state.S, i, j), d[i])
            square = (edges.weight[chunk] * (edges.pixels[chunk] - p.pixels).square()).sum(-1)
            cost = huber_cost(square, HUBER)
            total += float((cost * self.valid[chunk]).double().sum())
        return FACTOR * total

    def depth_step(self, xi: Float[Tensor, "n 7"], damping: float) -> Float[Tensor, "n p"]:
        """Return the change of the inverse depths after a step of the keyframes."""
        delta = torch.zeros_like(self.edges.inverse_depth)
        for source in self.sources:
            relative = xi[source.targets, :6] - source.adjoint @ xi[source.source]
            depth = source.damped_depth(damping)
            delta[source.source] = depth.after(relative.reshape(-1)).solution
        return delta
