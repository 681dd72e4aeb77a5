"""Conversion of matched edges to relative poses, which replace their matches.

Each directed edge is solved separately: Gauss-Newton on the motion from source to target with the
source's depth given, linearised again at each step. Where both keyframes have depth, the matches
also determine the ratio of their units, which loops need as a tracker drifts in scale.
Source: HI-SLAM2's buffer of relative poses, which linearises at the unchanged poses and has no
scale.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.projection import LinearProjection, linearise, relative_motion
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.lie import move
from geogs.loop.matched_edges import CHUNK, HUBER, MatchedEdges
from geogs.world.grid import SampleGrid
from geogs.world.loops import RelativePoses

STEPS = 8
"""Most steps of an edge."""
CONVERGED = 1e-6
"""Largest change of a motion's numbers at which a step is the last."""
MIN_WEIGHT = 0.1
"""Weight from which a cell counts as matched, 1 / pixel^2."""
MIN_MATCHED = 0.01
"""Fraction of all cells that must be matched and in front of the target."""
INDEPENDENT = 10.0
"""Effective number of independent measurements of an edge, as errors of neighbours are correlated;
HI-SLAM2 has 1. Measured: 30 or more on a rendered room."""
DAMPING = 1e-4
"""Damping of the six numbers of the motion, relative to the diagonal."""
LEAST_ROTATION = 2e-4
"""Least deviation of a rotation, radians, however well it fits; of a translation the same
fraction of the source's median depth."""
LEAST_SCALE = 2e-3
"""Least deviation of a ratio of units."""


def relative_poses(
    grid: SampleGrid,
    edges: MatchedEdges,
    T_cw: Float[Tensor, "n 4 4"],
    is_loop: bool,
    steps: int = STEPS,
    start: Float[Tensor, "e 4 4"] | None = None,
) -> RelativePoses:
    """Solve every edge; those with too few matched cells are left out.

    Matches and depths may be on a GPU; poses are on the CPU, and so is the result.

    The solution begins at the present poses, or at ``start``, the motion of each edge in its
    source's unit. With zero ``steps`` the start is the result: an adjustment of all edges has found
    it.

    Covariance is ``sigma^2 diag(H^-1)`` with ``sigma^2 = sum w r^2`` divided not by the number of
    cells, but by ``INDEPENDENT``. A loop's scale is the median ratio of the depths at matched
    cells; any other edge has scale 1, with the deviation of its worst angle or of its worst
    translation relative to depth, whichever is larger.
    """
    G, information, kept = [], [], []
    if start is None:
        start = relative_motion(T_cw, edges.source, edges.target)
    for first in range(0, len(edges.source), CHUNK):
        chunk = slice(first, first + CHUNK)
        solved, known, keep = _solve_edges(grid, edges, chunk, start[chunk], is_loop, steps)
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
    steps: int,
) -> tuple[Float[Tensor, "e 4 4"], Float[Tensor, "e 7"], Bool[Tensor, "e"]]:
    """Return similarity, information and whether to keep it, of each edge of a chunk."""
    j, weight = edges.target[chunk], edges.weight[chunk]
    d = edges.inverse_depth[edges.source[chunk]]
    linearised = partial(_linearised, edges, chunk, d)
    policy = Policy(steps, DAMPING, CONVERGED)
    T = minimise(T, linearised, _step, policy).state
    at = linearised(T)
    p, H, square = at.projection, at.damped(DAMPING), at.square
    variance = square[:, None] / INDEPENDENT * torch.linalg.inv(H).diagonal(dim1=-2, dim2=-1)
    depth = 1 / d.median(1).values.cpu().double()
    least = LEAST_ROTATION**2 * torch.ones_like(variance)
    least[:, :3] *= depth[:, None] ** 2
    variance = torch.maximum(variance, least)
    relative = torch.cat([variance[:, :3] / depth[:, None] ** 2, variance[:, 3:]], 1)
    scale_variance = relative.amax(1)
    matched = (weight.mean(-1) > MIN_WEIGHT) & p.valid
    if is_loop:
        log_scale, measured = _depth_ratio(grid, edges, j, p, d, matched)
        known = torch.isfinite(log_scale)
        scale_variance = torch.where(known, measured, scale_variance)
        scale_variance = scale_variance.clamp(min=LEAST_SCALE**2)
        scale = torch.where(known, log_scale, torch.zeros_like(log_scale)).exp()
        T = T.clone()
        T[:, :3] *= scale[:, None, None]
        variance[:, :3] *= scale[:, None] ** 2
    information = 1 / torch.cat([variance, scale_variance[:, None]], 1)
    keep = matched.double().mean(1).cpu() > MIN_MATCHED
    keep = keep & torch.isfinite(information).all(1) & torch.isfinite(T).flatten(1).all(1)
    return T, information.nan_to_num(0.0, 0.0, 0.0), keep


@dataclass(frozen=True)
class _LinearEdges:
    """Edges linearised at some motions; equations are float64 and on the CPU."""

    projection: LinearProjection
    hessian: Float[Tensor, "e 6 6"]
    gradient: Float[Tensor, "e 6"]
    square: Float[Tensor, "e"]
    """Robustly weighted sum of squared residuals."""

    def damped(self, damping: float) -> Float[Tensor, "e 6 6"]:
        """Return the Hessians with raised diagonals."""
        floor = damping * self.hessian.diagonal(dim1=-2, dim2=-1) + 1e-9
        return self.hessian + torch.diag_embed(floor)


def _linearised(
    edges: MatchedEdges,
    chunk: slice,
    inverse_depth: Float[Tensor, "e p"],
    T: Float[Tensor, "e 4 4"],
) -> _LinearEdges:
    p = linearise(edges.camera, edges.rays, T, inverse_depth)
    r, w = weighed_residuals(p, edges.pixels[chunk], edges.weight[chunk], HUBER)
    wJ = (p.pose_jacobian * w.mT[:, None]).flatten(2)
    H = (wJ @ p.pose_jacobian.flatten(2).mT).cpu().double()
    g = (wJ @ r.mT.flatten(1)[..., None])[..., 0].cpu().double()
    return _LinearEdges(p, H, g, (w * r.square()).sum((1, 2)).cpu().double())


def _step(T: Float[Tensor, "e 4 4"], linear: _LinearEdges, damping: float) -> Step[Tensor]:
    """Take a step; a motion whose step is not finite does not change."""
    step = torch.linalg.solve(linear.damped(damping), linear.gradient).nan_to_num(0.0, 0.0, 0.0)
    return Step(move(step, T), float(step.abs().max()))


def _depth_ratio(
    grid: SampleGrid,
    edges: MatchedEdges,
    target: Int[Tensor, "e"],
    p: LinearProjection,
    inverse_depth: Float[Tensor, "e p"],
    matched: Bool[Tensor, "e p"],
) -> tuple[Float[Tensor, "e"], Float[Tensor, "e"]]:
    """Return the log ratio of a length in the target's unit to the source's, and its variance.

    The median over matched cells that fall into the target, and the square of the median deviation,
    not divided by the number of cells. NaN where there is no such cell.
    """
    log_scale, variance = [], []
    for e, j in enumerate(target.tolist()):
        at = matched[e] & grid.inside(p.pixels[e])
        there = grid.sample_field(edges.inverse_depth[j][:, None], p.pixels[e][at])[:, 0]
        ratio = (inverse_depth[e][at] / (there * p.z[e][at])).double().log()
        centre = ratio.median() if len(ratio) else ratio.new_tensor(torch.nan)
        spread = (ratio - centre).abs().median() if len(ratio) else centre
        log_scale.append(centre)
        variance.append((1.4826 * spread).square())
    return torch.stack(log_scale), torch.stack(variance)
