"""Closing loops: vote, adjust relative poses robustly, then let the matches speak."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.loop.consistency import ConsistencyOptions, consistent_loops
from geogs.loop.matched_edges import MatchedEdges
from geogs.loop.pose_graph import PoseGraph, PoseGraphOptions, pose_correction, solve
from geogs.types import PoseCorrection
from geogs.world.loops import RelativePoses


@dataclass(frozen=True)
class ClosureOptions:
    """How loops are judged and closed."""

    consistency: ConsistencyOptions = field(default_factory=ConsistencyOptions)
    graph: PoseGraphOptions = field(default_factory=PoseGraphOptions)
    least_weight: float = 0.1
    """Share of its influence that a loop must keep to be believed."""


@dataclass(frozen=True)
class LoopClosure:
    """What closing loops brought."""

    correction: PoseCorrection
    """For tracker and map, by keyframe id."""
    relative: RelativePoses
    """The trusted edges and the loops that were believed, in the units after the correction: what
    the next closure starts with."""
    accepted: Bool[Tensor, "e"]
    """Marks the relative poses given that were kept."""
    inverse_depth: Float[Tensor, "n p"] | None
    """Adjusted with the matches, in each keyframe's unit *before* the correction; to be taken over
    first, as ``Tracker.correct`` multiplies by the scale. None without matches."""


def close_loops(
    ids: Sequence[int],
    T_cw: Float[Tensor, "n 4 4"],
    relative: RelativePoses,
    matches: MatchedEdges | None = None,
    options: ClosureOptions | None = None,
    fixed: int = 1,
    is_metric: bool = False,
) -> LoopClosure | None:
    """Correct keyframes ``ids`` (ascending) by their loops; None if no loop is believed.

    Loops that contradict the others are left out, those that the kernel lets go of too, and matches
    between their keyframes with them. The first keyframes, as many as are ``fixed``, keep pose and
    unit; all keep their unit where the map ``is_metric``.
    """
    options = options or ClosureOptions()
    keep = consistent_loops(T_cw, relative, options.consistency)
    are_fixed = torch.arange(len(T_cw)) < fixed
    result = solve(
        PoseGraph(T_cw, relative.select(keep), are_fixed, None, is_metric), options.graph
    )
    keep = keep.clone()
    keep[keep.clone()] = result.loop_weight >= options.least_weight
    if not bool((keep & relative.is_loop).any()):
        return None
    kept = relative.select(keep)
    if matches is not None:
        believed = _without(matches, relative.select(~keep), kept)
        result = solve(PoseGraph(result.S, kept, are_fixed, believed, is_metric), options.graph)
    return LoopClosure(
        pose_correction(ids, T_cw, result.S),
        kept.rescaled(result.scale),
        keep,
        result.inverse_depth,
    )


def _without(matches: MatchedEdges, rejected: RelativePoses, kept: RelativePoses) -> MatchedEdges:
    """The matches but those between keyframes whose every relative pose was rejected."""
    gone = _pairs(rejected.source, rejected.target) - _pairs(kept.source, kept.target)
    ends = zip(matches.source.tolist(), matches.target.tolist(), strict=True)
    stays = torch.tensor([(min(e), max(e)) not in gone for e in ends], dtype=torch.bool)
    return replace(
        matches,
        source=matches.source[stays],
        target=matches.target[stays],
        pixels=matches.pixels[stays],
        weight=matches.weight[stays],
    )


def _pairs(source: Tensor, target: Tensor) -> set[tuple[int, int]]:
    ends = zip(source.tolist(), target.tolist(), strict=True)
    return {(min(e), max(e)) for e in ends}
