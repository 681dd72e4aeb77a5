"""Dense matches between keyframes in a Sim(3) pose graph, their inverse depth eliminated.

A keyframe's similarity S takes the world to its camera in the keyframe's own unit of length. A
cell of keyframe i with ray X and inverse depth d lies at Y = s R X + d t in keyframe j, with
``(s R, t) = S_j S_i^-1``, and is seen at pi(K Y). Projection ignores scale, so an edge is
linearised in the six numbers [tau, phi] of the relative similarity; the chain to both keyframes,
``xi_rel = xi_j - Ad(S_ji) xi_i``, carries the scale of the source.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.linearise import EliminatedDepth, weighed_residuals
from geogs.bundle.problem import source_chunks, sources_within
from geogs.bundle.projection import linearise, project
from geogs.geometry.camera import Camera
from geogs.geometry.lie import sim3_adjoint, sim3_inverse


@dataclass(frozen=True)
class MatchedEdges:
    """Directed edges with a measured position in the target for every cell of the source."""

    camera: Camera
    rays: Float[Tensor, "p 3"]
    """K^-1 (x, y, 1) of each cell."""
    inverse_depth: Float[Tensor, "n p"]
    """Of every keyframe of the graph, in its own unit of length."""
    source: Int[Tensor, "e"]
    """Index of a keyframe; ascending."""
    target: Int[Tensor, "e"]
    pixels: Float[Tensor, "e p 2"]
    """Where the cells of the source are seen in the target."""
    weight: Float[Tensor, "e p 2"]
    """Inverse variance of x and y, 1 / pixel^2; 0 where nothing was matched."""


@dataclass(frozen=True)
class MatchOptions:
    """How matches count."""

    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    share: float = 1e-3
    """Factor of the cost. The cells of an edge err together, so that an edge of a thousand cells
    says little more than one of them; relative poses are weighed in the same way."""
    depth_damping: float = 1e-3
    """Damping of inverse depth relative to the mean curvature of its keyframe."""
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2
    chunk: int = 24
    """Edges linearised at a time; bounds memory."""


@dataclass(frozen=True)
class BlockEquations:
    """Contributions to normal equations in blocks of one keyframe each."""

    row: Int[Tensor, "b"]
    column: Int[Tensor, "b"]
    block: Float[Tensor, "b 7 7"]
    """Added to the matrix at keyframes (row, column); float64."""
    gradient: Float[Tensor, "n 7"]
    """Right-hand side, the direction of descent; float64."""


@dataclass(frozen=True)
class SimilarityStar:
    """A source with its edges, linearised in their relative similarities."""

    source: int
    targets: Int[Tensor, "k"]
    adjoint: Float[Tensor, "k 6 7"]
    """First six rows of Ad(S_ji)."""
    depth: EliminatedDepth
    """What brings its inverse depth back after the keyframes have moved."""


@dataclass(frozen=True)
class LinearMatches:
    """All matched edges at one state."""

    equations: BlockEquations
    stars: tuple[SimilarityStar, ...]
    valid: Bool[Tensor, "e p"]
    """Cells in front of their target; only these count."""


def relative_similarity(
    S: Float[Tensor, "n 4 4"], source: Int[Tensor, "e"], target: Int[Tensor, "e"]
) -> Float[Tensor, "e 4 4"]:
    """S_ji = S_j S_i^-1 of every edge i -> j."""
    return S[target] @ sim3_inverse(S[source])


def match_cost(
    edges: MatchedEdges,
    S: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "n p"],
    valid: Bool[Tensor, "e p"],
    options: MatchOptions,
) -> float:
    """Huber's cost over the given cells; those now behind their target are held in front of it.

    The cells are given, so that a step cannot lower the cost by losing some from sight.
    """
    total = 0.0
    for start in range(0, len(edges.source), options.chunk):
        chunk = slice(start, start + options.chunk)
        i, j = edges.source[chunk], edges.target[chunk]
        p = project(edges.camera, edges.rays, relative_similarity(S, i, j), inverse_depth[i])
        square = (edges.weight[chunk] * (edges.pixels[chunk] - p.pixels).square()).sum(-1)
        linear = 2 * options.huber * square.sqrt() - options.huber**2
        cost = torch.where(square > options.huber**2, linear, square)
        total += float((cost * valid[chunk]).double().sum())
    return options.share * total


def linearise_matches(
    edges: MatchedEdges,
    S: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "n p"],
    damping: float,
    options: MatchOptions,
) -> LinearMatches:
    """Normal equations over the keyframes; ``damping`` is added to depths relative to curvature."""
    n = len(S)
    gradient = torch.zeros(n, 7, dtype=torch.float64)
    rows, columns, blocks = [], [], []
    stars: list[SimilarityStar] = []
    valid = []
    for chunk in source_chunks(edges.source, options.chunk):
        i, j = edges.source[chunk], edges.target[chunk]
        S_ji = relative_similarity(S, i, j)
        p = linearise(edges.camera, edges.rays, S_ji, inverse_depth[i])
        valid.append(p.valid)
        r, w = weighed_residuals(p, edges.pixels[chunk], edges.weight[chunk], options.huber)
        w = options.share * w
        J, D = p.pose_jacobian, p.depth_jacobian
        wJ = J * w.mT[:, None]
        H = (wJ.flatten(2) @ J.flatten(2).mT).double()
        v = (wJ.flatten(2) @ r.mT.flatten(1)[..., None])[..., 0].double()
        coupling = (wJ * D.mT[:, None]).sum(2)
        curvature, b = (w * D.square()).sum(-1), (w * D * r).sum(-1)
        adjoint = sim3_adjoint(S_ji)[:, :6]
        for frame, e in sources_within(i):
            c = curvature[e].sum(0)
            damped = c * (1 + damping) + options.depth_damping * c.mean() + 1e-12
            depth = EliminatedDepth(coupling[e].flatten(0, 1), damped, b[e].sum(0))
            star = SimilarityStar(frame, j[e], adjoint[e], depth)
            at, block, g = _reduced(star, H[e], v[e])
            gradient.index_add_(0, at, g)
            rows.append(at.repeat_interleave(len(at)))
            columns.append(at.repeat(len(at)))
            blocks.append(block.flatten(0, 1))
            stars.append(star)
    if not stars:
        empty = torch.zeros(0, dtype=torch.long)
        none = BlockEquations(empty, empty, gradient.new_zeros(0, 7, 7), gradient)
        return LinearMatches(none, (), torch.zeros(edges.weight.shape[:2], dtype=torch.bool))
    equations = BlockEquations(torch.cat(rows), torch.cat(columns), torch.cat(blocks), gradient)
    return LinearMatches(equations, tuple(stars), torch.cat(valid))


def depth_step(
    linear: LinearMatches, xi: Float[Tensor, "n 7"], inverse_depth: Float[Tensor, "n p"]
) -> Float[Tensor, "n p"]:
    """Step of inverse depth that goes with the step ``xi`` of the keyframes."""
    delta = torch.zeros_like(inverse_depth)
    for star in linear.stars:
        relative = xi[star.targets, :6] - star.adjoint @ xi[star.source]
        delta[star.source] = star.depth.step(relative.reshape(-1))
    return delta


def _reduced(
    star: SimilarityStar, hessian: Float[Tensor, "k 6 6"], gradient: Float[Tensor, "k 6"]
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m m 7 7"], Float[Tensor, "m 7"]]:
    """A star without its depths over its keyframes: indices, blocks, gradient."""
    k = len(star.targets)
    block, g = star.depth.reduce(torch.block_diag(*hessian), gradient.reshape(-1))
    target = torch.eye(6, 7, dtype=torch.float64)
    chain = torch.cat([torch.block_diag(*[target] * k), -star.adjoint.reshape(6 * k, 7)], 1)
    at = torch.cat([star.targets, star.targets.new_tensor([star.source])])
    full = (chain.mT @ block @ chain).reshape(k + 1, 7, k + 1, 7).transpose(1, 2)
    return at, full, (chain.mT @ g).reshape(k + 1, 7)
