"""Relative poses out of matched edges: what remains of an edge once its matches are let go.

Each directed edge is solved on its own: Gauss-Newton on the motion from source to target with the
source's depth given, linearised anew at each step. Where both keyframes know their depth, the
matches also tell the ratio of their units, which a tracker that drifts in scale needs of its loops.
Source: HI-SLAM2's buffer of relative poses; that linearises at the unchanged poses and knows no
scale, this does not.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.linearise import weighed_residuals
from geogs.bundle.projection import LinearProjection, linearise
from geogs.geometry.lie import move, se3_inverse
from geogs.loop.matched_edges import MatchedEdges
from geogs.world.grid import SampleGrid
from geogs.world.loops import RelativePoses


@dataclass(frozen=True)
class RelativePoseOptions:
    """How edges are solved, and which are kept."""

    iterations: int = 8
    """At most."""
    settled: float = 1e-6
    """A step in which no number of a motion changes by more is the last."""
    huber: float = 3.0
    """Standard deviations beyond which a residual counts linearly."""
    sure: float = 0.1
    """1 / pixel^2: the weight from which a cell counts as matched."""
    share: float = 0.01
    """Of all cells that must be matched and in front of the target."""
    independent: float = 10.0
    """Measurements that the cells of an edge amount to, as neighbours err together; the source
    has 1. Measured: 30 or more on a rendered room."""
    damping: float = 1e-4
    """Added to the curvature of the six numbers of the motion, relative to its diagonal."""
    least_turn: float = 2e-4
    """Radians: no motion is surer than this, however well it fits; translation in the same
    proportion to the source's median depth."""
    least_scale: float = 2e-3
    """No ratio of units is surer than this."""
    chunk: int = 24
    """Edges solved at a time; bounds memory."""


def relative_poses(
    grid: SampleGrid,
    edges: MatchedEdges,
    T_cw: Float[Tensor, "n 4 4"],
    is_loop: bool,
    options: RelativePoseOptions | None = None,
    start: Float[Tensor, "e 4 4"] | None = None,
) -> RelativePoses:
    """Solve every edge; those with too few sure cells are left out.

    Matches and depths may be on a GPU; poses are on the CPU, and so is the result.

    From the present poses on, or from ``start``, the motion of each edge in its source's unit.

    Covariance is ``sigma^2 diag(H^-1)`` with ``sigma^2 = sum w r^2`` divided not by the number of
    cells, but by ``options.independent``. A loop's scale is the median ratio of the depths at
    matched cells; any other edge has scale 1, as unsure as its worst angle or its worst
    translation relative to depth, whichever is less sure.
    """
    options = options or RelativePoseOptions()
    G, information, kept = [], [], []
    if start is None:
        start = T_cw[edges.target] @ se3_inverse(T_cw[edges.source])
    for first in range(0, len(edges.source), options.chunk):
        chunk = slice(first, first + options.chunk)
        solved, known, keep = _solve_edges(grid, edges, chunk, start[chunk], is_loop, options)
        G.append(solved)
        information.append(known)
        kept.append(keep)
    if not kept:
        none = T_cw.new_zeros(0, 7)
        return RelativePoses(edges.source, edges.target, T_cw[:0], none, none[:, 0].bool())
    marks = torch.full((len(edges.source),), is_loop)
    all_edges = RelativePoses(
        edges.source, edges.target, torch.cat(G), torch.cat(information), marks
    )
    return all_edges.select(torch.cat(kept))


def _solve_edges(
    grid: SampleGrid,
    edges: MatchedEdges,
    chunk: slice,
    T: Float[Tensor, "e 4 4"],
    is_loop: bool,
    options: RelativePoseOptions,
) -> tuple[Float[Tensor, "e 4 4"], Float[Tensor, "e 7"], Bool[Tensor, "e"]]:
    """Similarity, information and whether it is worth keeping, of each edge of a chunk."""
    i, j = edges.source[chunk], edges.target[chunk]
    pixels, weight, d = edges.pixels[chunk], edges.weight[chunk], edges.inverse_depth[i]
    for _ in range(options.iterations):
        p = linearise(edges.camera, edges.rays, T, d)
        H, g, _ = _normal_equations(p, pixels, weight, options)
        step = torch.linalg.solve(H, g).nan_to_num(0.0, 0.0, 0.0)
        T = move(step, T)
        if float(step.abs().max()) < options.settled:
            break
    p = linearise(edges.camera, edges.rays, T, d)
    H, _, square = _normal_equations(p, pixels, weight, options)
    variance = (
        square[:, None] / options.independent * torch.linalg.inv(H).diagonal(dim1=-2, dim2=-1)
    )
    depth = 1 / d.median(1).values.cpu().double()
    least = options.least_turn**2 * torch.ones_like(variance)
    least[:, :3] *= depth[:, None] ** 2
    variance = torch.maximum(variance, least)
    relative = torch.cat([variance[:, :3] / depth[:, None] ** 2, variance[:, 3:]], 1)
    scale_variance = relative.amax(1)
    sure = (weight.mean(-1) > options.sure) & p.valid
    if is_loop:
        log_scale, measured = _depth_ratio(grid, edges, j, p, d, sure)
        known = torch.isfinite(log_scale)
        scale_variance = torch.where(known, measured, scale_variance)
        scale_variance = scale_variance.clamp(min=options.least_scale**2)
        scale = torch.where(known, log_scale, torch.zeros_like(log_scale)).exp()
        T = T.clone()
        T[:, :3] *= scale[:, None, None]
        variance[:, :3] *= scale[:, None] ** 2
    information = 1 / torch.cat([variance, scale_variance[:, None]], 1)
    keep = sure.double().mean(1).cpu() > options.share
    keep = keep & torch.isfinite(information).all(1) & torch.isfinite(T).flatten(1).all(1)
    return T, information.nan_to_num(0.0, 0.0, 0.0), keep


def _normal_equations(
    p: LinearProjection, pixels: Tensor, weight: Tensor, options: RelativePoseOptions
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"], Float[Tensor, "e"]]:
    """Damped H, g and the robustly weighted sum of squared residuals; float64, on the CPU."""
    r, w = weighed_residuals(p, pixels, weight, options.huber)
    wJ = (p.pose_jacobian * w.mT[:, None]).flatten(2)
    H = (wJ @ p.pose_jacobian.flatten(2).mT).cpu().double()
    g = (wJ @ r.mT.flatten(1)[..., None])[..., 0].cpu().double()
    floor = options.damping * H.diagonal(dim1=-2, dim2=-1) + 1e-9
    return H + torch.diag_embed(floor), g, (w * r.square()).sum((1, 2)).cpu().double()


def _depth_ratio(
    grid: SampleGrid,
    edges: MatchedEdges,
    target: Int[Tensor, "e"],
    p: LinearProjection,
    inverse_depth: Float[Tensor, "e p"],
    sure: Bool[Tensor, "e p"],
) -> tuple[Float[Tensor, "e"], Float[Tensor, "e"]]:
    """Log of a length in the target's unit over the same in the source's, and its variance.

    The median over sure cells that fall into the target, and the square of the median deviation,
    not divided by the number of cells. NaN where there is no such cell.
    """
    log_scale, variance = [], []
    for e, j in enumerate(target.tolist()):
        at = sure[e] & grid.inside(p.pixels[e])
        there = grid.sample_field(edges.inverse_depth[j][:, None], p.pixels[e][at])[:, 0]
        ratio = (inverse_depth[e][at] / (there * p.z[e][at])).double().log()
        centre = ratio.median() if len(ratio) else ratio.new_tensor(torch.nan)
        spread = (ratio - centre).abs().median() if len(ratio) else centre
        log_scale.append(centre)
        variance.append((1.4826 * spread).square())
    return torch.stack(log_scale), torch.stack(variance)
