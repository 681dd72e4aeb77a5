"""Closing loops: vote, adjust relative poses robustly, then adjust to the matches; and application
of the result to keyframes that have changed meanwhile."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.loop.consistency import consistent_loops
from geogs.loop.matched_edges import MatchedEdges
from geogs.loop.pose_graph import PoseGraph, pose_correction, solve
from geogs.threads import on_one_torch_thread
from geogs.types import PoseCorrection
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import RelativePoses

LEAST_WEIGHT = 0.1
"""Least robust weight of an accepted loop."""


@dataclass(frozen=True)
class ClosingQuestion:
    """Input of a closing; immutable."""

    ids: Sequence[int]
    """Keyframe ids, ascending."""
    T_cw: Float[Tensor, "n 4 4"]
    """Poses of the keyframes, world to camera."""
    relative: RelativePoses
    """Relative poses between indices in ``ids``."""
    matches: MatchedEdges | None = None
    fixed: int = 1
    """Number of first keyframes whose pose and unit are fixed."""
    is_metric: bool = False
    """Whether all units are fixed."""
    inverse_depths: Mapping[int, Float[Tensor, "p"]] = field(default_factory=dict)
    """Inverse depths then, by id; an adjusted depth is not applied if it was replaced since."""


@dataclass(frozen=True)
class LoopClosure:
    """Result of closing loops."""

    correction: PoseCorrection
    """Correction for tracker and map, by keyframe id."""
    accepted: Bool[Tensor, "e"]
    """Whether each of the given relative poses was accepted."""
    inverse_depth: Float[Tensor, "n p"] | None
    """Inverse depths adjusted with the matches, in each keyframe's unit *before* the correction;
    to be applied first, as ``KeyframeSet.correct`` multiplies by the scale. None without
    matches."""


@on_one_torch_thread
def close_loops(question: ClosingQuestion) -> LoopClosure | None:
    """Correct keyframes by their loops, in any thread; None if no loop is accepted.

    Loops that contradict the others or get a low robust weight are left out, and so are the matches
    between their keyframes.
    """
    T_cw, relative, is_metric = question.T_cw, question.relative, question.is_metric
    keep = consistent_loops(T_cw, relative)
    are_fixed = torch.arange(len(T_cw)) < question.fixed
    result = solve(PoseGraph(T_cw, relative.select(keep), are_fixed, None, is_metric))
    keep = keep.clone()
    keep[keep.clone()] = result.loop_weight >= LEAST_WEIGHT
    if not bool((keep & relative.is_loop).any()):
        return None
    if question.matches is not None:
        kept = relative.select(keep)
        believed = _without(question.matches, relative.select(~keep), kept)
        result = solve(PoseGraph(result.S, kept, are_fixed, believed, is_metric))
    return LoopClosure(pose_correction(question.ids, T_cw, result.S), keep, result.inverse_depth)


def brought_forward(
    correction: PoseCorrection, T_cw: Mapping[int, Float[Tensor, "4 4"]]
) -> PoseCorrection:
    """Transfer a correction of earlier keyframes to the present ones.

    ``T_cw`` has the present poses, by id. With T the pose before and S the similarity after, world
    to camera in the keyframe's unit of before, a correction moves what a keyframe shows by
    S^-1 T. A keyframe that has been adjusted meanwhile moves by the same, S' = T' T^-1 S; a newer
    one by that of the last one before it. Removed keyframes are left out.
    """
    known, reference = sorted(correction.before), 0
    after, scale = {}, {}
    for id, now in sorted(T_cw.items()):
        while reference + 1 < len(known) and known[reference + 1] <= id:
            reference += 1
        of = known[reference]
        before, s = correction.before[of], correction.scale[of]
        scale[id] = s
        if torch.equal(now, before):
            after[id] = correction.after[of]
            continue
        since = now @ se3_inverse(before)
        since[:3, 3] /= s  # S' / s, as after is S / s
        after[id] = since @ correction.after[of]
    return PoseCorrection(dict(T_cw), after, scale)


def take_over_depths(
    keyframes: KeyframeSet, edges: Collection[Pair], inverse_depth: Mapping[int, Float[Tensor, "p"]]
) -> None:
    """Set keyframes' inverse depths from a closing, before its scales are applied.

    Only of sources of the frame graph's edges: others only have the matches of loops left, which
    determine depth less well than all those it was estimated from.
    """
    sources = {i for i, _ in edges}
    for id, own in inverse_depth.items():
        if id in sources:
            keyframe = keyframes[id]
            keyframe.inverse_depth = own.to(keyframe.inverse_depth)


def _without(matches: MatchedEdges, rejected: RelativePoses, kept: RelativePoses) -> MatchedEdges:
    """Return the matches except between keyframes whose relative poses were all rejected."""
    gone = {*rejected.pairs} - {*kept.pairs}
    ends = zip(matches.source.tolist(), matches.target.tolist(), strict=True)
    stays = torch.tensor([(min(e), max(e)) not in gone for e in ends], dtype=torch.bool)
    columns = ("source", "target", "pixels", "weight")
    return replace(matches, **{c: getattr(matches, c)[stays] for c in columns})
