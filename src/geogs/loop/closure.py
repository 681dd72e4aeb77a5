"""Closing loops: vote, adjust relative poses robustly, then let the matches speak; and how the
answer meets keyframes as they are by then."""

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
"""Fraction of its influence that a loop must keep to be believed."""


@dataclass(frozen=True)
class ClosingQuestion:
    """What a closing is computed from; nothing in it changes any more."""

    ids: Sequence[int]
    """Keyframes, ascending."""
    T_cw: Float[Tensor, "n 4 4"]
    """Their poses, world to camera."""
    relative: RelativePoses
    """Between places in ``ids``."""
    matches: MatchedEdges | None = None
    fixed: int = 1
    """Keyframes at the beginning that keep pose and unit."""
    is_metric: bool = False
    """Whether all keep their unit."""
    inverse_depths: Mapping[int, Float[Tensor, "p"]] = field(default_factory=dict)
    """What they were, by id; a depth that was replaced since is not taken over."""


@dataclass(frozen=True)
class LoopClosure:
    """What closing loops brought."""

    correction: PoseCorrection
    """What tracker and map follow, by keyframe id."""
    accepted: Bool[Tensor, "e"]
    """Marks the relative poses given that were kept."""
    inverse_depth: Float[Tensor, "n p"] | None
    """Adjusted with the matches, in each keyframe's unit *before* the correction; to be taken over
    first, as ``KeyframeSet.correct`` multiplies by the scale. None without matches."""


@on_one_torch_thread
def close_loops(question: ClosingQuestion) -> LoopClosure | None:
    """Correct keyframes by their loops, in any thread; None if no loop is believed.

    Loops that contradict the others are left out, those that the kernel lets go of too, and matches
    between their keyframes with them.
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
    """The correction of keyframes as they are now, of one of keyframes as they were.

    ``T_cw`` has the present poses, by id. With T the pose before and S the similarity after, world
    to camera in the keyframe's unit of before, a correction moves what a keyframe shows by
    S^-1 T. A keyframe that has been adjusted meanwhile moves by the same, S' = T' T^-1 S; one that
    came later by that of the last one before it. Who is gone is left out.
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
    """Give keyframes the inverse depth that a closing has found, before its scales are applied.

    Only those of the frame graph's edges: what is left of the matches of others is a loop's, which
    alone says less of a depth than all those that have made it.
    """
    sources = {i for i, _ in edges}
    for id, own in inverse_depth.items():
        if id in sources:
            keyframe = keyframes[id]
            keyframe.inverse_depth = own.to(keyframe.inverse_depth)


def _without(matches: MatchedEdges, rejected: RelativePoses, kept: RelativePoses) -> MatchedEdges:
    """The matches but those between keyframes whose every relative pose was rejected."""
    gone = {*rejected.pairs} - {*kept.pairs}
    ends = zip(matches.source.tolist(), matches.target.tolist(), strict=True)
    stays = torch.tensor([(min(e), max(e)) not in gone for e in ends], dtype=torch.bool)
    columns = ("source", "target", "pixels", "weight")
    return replace(matches, **{c: getattr(matches, c)[stays] for c in columns})
