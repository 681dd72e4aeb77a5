"""Constraints between the keyframes of one tracker: relative poses by id, and matches for closing
loops.

Matched edges become relative poses, which replace their matches: each directed edge is solved
separately, by Gauss-Newton on the motion from source to target with the source's depth given,
linearised again at each step. Where both keyframes have depth, the matches also determine the ratio
of their units, which loops need as a tracker drifts in scale.
Source: HI-SLAM2's buffer of relative poses, which linearises at the unchanged poses and has no
scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.projection import LinearProjection, linearise
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.lie import move, scaled, se3_inverse, sim3_inverse, sim3_log
from geogs.loop.matched_edges import CHUNK, HUBER, MatchedEdges
from geogs.tracking.graph.dynamic_cells import static_weight
from geogs.world.edges import Edge, Pair, edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs.world.loops import Loop, RelativePoses

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
AGREEING_LOOPS = 2
"""Number of loops that have to agree before a segment is joined to another: one may be false."""
JOIN_TOLERANCE = 0.12
"""Largest difference between loops that agree: radians, fraction of the median depth, or of the
scale. Segments drift by as much internally."""


def relative_poses(
    grid: SampleGrid,
    edges: MatchedEdges,
    start: Float[Tensor, "e 4 4"],
    is_loop: bool,
    steps: int = STEPS,
) -> RelativePoses:
    """Solve every edge; those with too few matched cells are left out.

    Matches and depths may be on a GPU; poses are on the CPU, and so is the result.

    The solution begins at ``start``, the motion of each edge in its source's unit. With zero
    ``steps`` that is the result: an adjustment of all edges has found it.

    Covariance is ``sigma^2 diag(H^-1)`` with ``sigma^2 = sum w r^2`` divided not by the number of
    cells, but by ``INDEPENDENT``. A loop's scale is the median ratio of the depths at matched
    cells; any other edge has scale 1, with the deviation of its worst angle or of its worst
    translation relative to depth, whichever is larger.
    """
    chunks = [slice(n, n + CHUNK) for n in range(0, len(edges.source), CHUNK)]
    solved = [_solve_edges(grid, edges, c, start[c], is_loop, steps) for c in chunks]
    G, information, keep = (torch.cat(each) for each in zip(*solved, strict=True))
    marks = torch.full((len(edges.source),), is_loop)
    return RelativePoses(edges.source, edges.target, G, information, marks).select(keep)


def _solve_edges(
    grid: SampleGrid,
    edges: MatchedEdges,
    chunk: slice,
    T: Float[Tensor, "e 4 4"],
    is_loop: bool,
    steps: int,
) -> tuple[Float[Tensor, "e 4 4"], Float[Tensor, "e 7"], Bool[Tensor, "e"]]:
    """Return similarity, information and whether to keep it, of each edge of a chunk."""
    j = edges.target[chunk]
    weight = edges.weight[chunk]
    d = edges.inverse_depth[edges.source[chunk]]
    linearised = partial(_linearised, edges, chunk, d)
    policy = Policy(steps, DAMPING, CONVERGED)
    T = minimise(T, linearised, _step, policy).state
    at = linearised(T)
    p = at.projection
    inverse = torch.linalg.inv(at.damped(DAMPING)).diagonal(dim1=-2, dim2=-1)
    variance = at.square[:, None] / INDEPENDENT * inverse
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
    log_scale = []
    variance = []
    for e, j in enumerate(target.tolist()):
        at = matched[e] & grid.inside(p.pixels[e])
        there = grid.sample_field(edges.inverse_depth[j][:, None], p.pixels[e][at])[:, 0]
        ratio = (inverse_depth[e][at] / (there * p.z[e][at])).double().log()
        centre = ratio.median() if len(ratio) else ratio.new_tensor(torch.nan)
        spread = (ratio - centre).abs().median() if len(ratio) else centre
        log_scale.append(centre)
        variance.append((1.4826 * spread).square())
    return torch.stack(log_scale), torch.stack(variance)


def joined(parts: Sequence[RelativePoses]) -> RelativePoses:
    """Concatenate relative poses."""
    columns = ("source", "target", "G", "information", "is_loop")
    return RelativePoses(*(torch.cat([getattr(p, c) for p in parts]) for c in columns))


def of_edges(segment: KeyframeSet, edges: Mapping[Pair, Edge]) -> RelativePoses:
    """Compute relative poses, between ids, from fitted edges of a frame graph.

    Of the two directions of a pair the one from the earlier keyframe is used.
    """
    pairs = sorted(e for e in edges if e[0] < e[1])
    if not pairs:
        return RelativePoses.none()
    ids = sorted({k for p in pairs for k in p})
    grid = segment.grid
    matched = _matched(segment, grid, ids, pairs, *edge_matches(grid, [edges[p] for p in pairs]))
    # A bundle adjustment has fitted them, with more data than these matches alone.
    start = segment.relative_poses(pairs)
    return _named(relative_poses(grid, matched, start, False, steps=0), ids)


def closing_matches(
    segment: KeyframeSet, edges: Mapping[Pair, Edge], loops: Sequence[Loop]
) -> MatchedEdges | None:
    """Return matches between indices in the segment's order, on the CPU; None without any.

    Both directions of the frame graph's edges and of the loops within the segment; where a pair is
    in both, the frame graph's.
    """
    found: dict[Pair, tuple[Tensor, Tensor]] = {}
    for loop in loops:
        if loop.first in segment and loop.second in segment:
            pairs = (loop.first, loop.second), (loop.second, loop.first)
            for pair, flow in zip(pairs, loop.flows, strict=True):
                found[pair] = flow.pixels[0], flow.weight[0]
    for pair, edge in edges.items():
        (pixels,), (weight,) = edge_matches(segment.grid, [edge])
        found[pair] = pixels, weight
    if not found:
        return None
    directed = sorted(found)
    each = (torch.stack([found[p][k] for p in directed]) for k in (0, 1))
    return _matched(segment, _on_cpu(segment.grid), segment.ids, directed, *each)


def _matched(
    segment: KeyframeSet,
    grid: SampleGrid,
    ids: Sequence[int],
    directed: Sequence[Pair],
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
) -> MatchedEdges:
    """Convert matches of pairs of ids to indices in ``ids``, on the grid's device, without dynamic
    cells."""
    slot = {k: n for n, k in enumerate(ids)}
    there = grid.rays.device
    weight = static_weight(segment, directed, pixels, weight)
    return MatchedEdges(
        grid.camera,
        grid.rays,
        segment.inverse_depths(ids).to(there),
        torch.tensor([slot[i] for i, _ in directed]),
        torch.tensor([slot[j] for _, j in directed]),
        pixels.to(there).float(),
        weight.to(there).float(),
    )


def of_poses(segment: KeyframeSet, ids: Sequence[int]) -> RelativePoses:
    """Return relative poses between neighbours in a list of ids, with the largest information."""
    if len(ids) < 2:
        return RelativePoses.none()
    T_cw = segment.poses(ids)
    depth = segment.median_depths(ids[1:])
    most = 1 / torch.tensor([LEAST_ROTATION] * 6 + [LEAST_SCALE]).double().square()
    information = most.repeat(len(ids) - 1, 1)
    information[:, :3] /= depth[:, None].square()
    slots = torch.arange(len(ids))
    is_loop = torch.zeros(len(ids) - 1, dtype=torch.bool)
    G = T_cw[1:] @ se3_inverse(T_cw[:-1])
    return _named(RelativePoses(slots[:-1], slots[1:], G, information, is_loop), ids)


def of_loop(keyframes: KeyframeTable, loop: Loop) -> RelativePoses:
    """Compute relative poses, between ids, of a loop: one for each direction of its flow."""
    one, other = keyframes[loop.first], keyframes[loop.second]
    there, back = loop.flows
    grid = _on_cpu(keyframes.grid)
    matched = MatchedEdges(
        grid.camera,
        grid.rays,
        torch.stack([one.inverse_depth, other.inverse_depth]).cpu(),
        torch.tensor([0, 1]),
        torch.tensor([1, 0]),
        torch.cat([there.pixels, back.pixels]).cpu(),
        torch.cat([there.weight, back.weight]).cpu(),
    )
    T = loop.T_ji.cpu()
    start = torch.stack([T, se3_inverse(scaled(T, loop.scale))])
    return _named(relative_poses(grid, matched, start, True), [loop.first, loop.second])


def _on_cpu(grid: SampleGrid) -> SampleGrid:
    """Return the grid on the CPU, where relative poses are solved."""
    return SampleGrid(grid.camera) if grid.on_gpu else grid


def between_positions(relative: RelativePoses, ids: Sequence[int]) -> RelativePoses:
    """Convert relative poses between ids to indices in the sorted list ``ids``."""
    sorted_ids = torch.tensor(ids)
    return replace(
        relative,
        source=torch.searchsorted(sorted_ids, relative.source),
        target=torch.searchsorted(sorted_ids, relative.target),
    )


def rescaled(relative: RelativePoses, scale: Mapping[int, float]) -> RelativePoses:
    """Rescale relative poses between ids after each keyframe's unit was divided by its scale."""
    if not scale or not len(relative):
        return relative
    ids = sorted(scale)
    factors = torch.tensor([scale[k] for k in ids], dtype=torch.float64)
    return _named(between_positions(relative, ids).rescaled(factors), ids)


def _named(relative: RelativePoses, ids: Sequence[int]) -> RelativePoses:
    """Convert relative poses between indices in a list of ids to the ids."""
    names = torch.tensor(ids)
    return replace(relative, source=names[relative.source], target=names[relative.target])


def thinned(relative: RelativePoses, most: int) -> RelativePoses:
    """Remove every second relative pose of the older half if there are more than ``most``."""
    n = len(relative)
    if n <= most:
        return relative
    place = torch.arange(n)
    return relative.select((place >= n // 2) | (place % 2 == 0))


def squared_errors(segment: KeyframeSet, relative: RelativePoses) -> Float[Tensor, "e"]:
    """Return squared errors of relative poses between ids, in own variances, at present."""
    error = sim3_log(relative.G @ sim3_inverse(_present(segment, relative)))
    return (relative.information * error.square()).sum(-1)


def differences(segment: KeyframeSet, relative: RelativePoses) -> Float[Tensor, "e"]:
    """Return the :func:`disagreement` of relative poses between ids with the present poses, in the
    frames of their targets."""
    depth = segment.median_depths(relative.target.tolist())
    return disagreement(relative.G, _present(segment, relative), depth)


def _present(segment: KeyframeSet, relative: RelativePoses) -> Float[Tensor, "e 4 4"]:
    ends = zip(relative.source.tolist(), relative.target.tolist(), strict=True)
    return segment.relative_poses(list(ends))


def disagreement(
    S: Float[Tensor, "*b 4 4"], other: Float[Tensor, "*b 4 4"], depth: Float[Tensor, "*b"]
) -> Float[Tensor, "*b"]:
    """Return the largest of rotation in radians, shift over depth, and change of scale."""
    error = sim3_log(S @ sim3_inverse(other)).abs()
    shift = error[..., :3].norm(dim=-1) / depth
    rotation = error[..., 3:6].norm(dim=-1)
    return torch.stack([shift, rotation, error[..., 6]]).amax(0)
