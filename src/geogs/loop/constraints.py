"""Constraints between the keyframes of one tracker: relative poses by id, and matches for closing
loops."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import relative_motion
from geogs.geometry.lie import scaled, se3_inverse, sim3_inverse, sim3_log
from geogs.loop.matched_edges import MatchedEdges
from geogs.loop.relative_pose import LEAST_ROTATION, LEAST_SCALE, relative_poses
from geogs.tracking.graph.dynamic_cells import static_weight
from geogs.world.edges import Edge, Pair, edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs.world.loops import Loop, RelativePoses

AGREEING_LOOPS = 2
"""Number of loops that have to agree before a segment is joined to another: one may be false."""
JOIN_TOLERANCE = 0.12
"""Largest difference between loops that agree: radians, fraction of the median depth, or of the
scale. Segments drift by as much internally."""


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
    ids, grid = sorted({k for p in pairs for k in p}), segment.grid
    matched = _matched(segment, grid, ids, pairs, *edge_matches(grid, [edges[p] for p in pairs]))
    # A bundle adjustment has fitted them, with more data than these matches alone.
    return _named(relative_poses(grid, matched, segment.poses(ids), False, steps=0), ids)


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
    slot, there = {k: n for n, k in enumerate(ids)}, grid.rays.device
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
    poses = torch.stack([one.T_cw, other.T_cw])
    solved = relative_poses(grid, matched, poses, True, start=start)
    return _named(solved, [loop.first, loop.second])


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


def squared_errors(T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses) -> Float[Tensor, "e"]:
    """Return squared errors of relative poses between indices at given poses, in own variances."""
    now = relative_motion(T_cw, relative.source, relative.target)
    error = sim3_log(relative.G @ sim3_inverse(now))
    return (relative.information * error.square()).sum(-1)


def differences(
    T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses, depth: Float[Tensor, "n"]
) -> Float[Tensor, "e"]:
    """Return the :func:`disagreement` of relative poses between indices with given poses, in the
    frames of their targets, whose median depth is ``depth``."""
    now = relative_motion(T_cw, relative.source, relative.target)
    return disagreement(relative.G, now, depth[relative.target])


def disagreement(
    S: Float[Tensor, "*b 4 4"], other: Float[Tensor, "*b 4 4"], depth: Float[Tensor, "*b"]
) -> Float[Tensor, "*b"]:
    """Return the largest of rotation in radians, shift over depth, and change of scale."""
    error = sim3_log(S @ sim3_inverse(other)).abs()
    shift, rotation = error[..., :3].norm(dim=-1) / depth, error[..., 3:6].norm(dim=-1)
    return torch.stack([shift, rotation, error[..., 6]]).amax(0)
