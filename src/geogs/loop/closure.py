"""Closing loops: vote, adjust relative poses robustly, then adjust to the matches; and application
of the result to keyframes that have changed meanwhile.

A loop from keyframe i to j with measurement G implies the drift ``D = S_j^-1 G S_i`` between the
two, a similarity from the world as mapped around i to that around j. Two true loops imply the same
D, except for their noise and the drift between their first and between their second ends (the cycle
through both loops and the odometry between them). False loops do not, unless they share a cause,
such as two rooms of similar appearance; then the larger set is right more often. Loops that
contradict the others are left out before the adjustment.
Source: pairwise consistency maximisation (Mangelson et al. 2018), greedily.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.errors import GeogsError
from geogs.geometry.lie import se3_inverse, sim3_adjoint, sim3_inverse, sim3_log
from geogs.loop.matched_edges import MatchedEdges
from geogs.loop.pose_graph import DRIFT, PoseGraph, pose_correction, solve
from geogs.threads import on_one_torch_thread
from geogs.types import PoseCorrection
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import RelativePoses

AGREEMENT = 35.3
"""Squared error, in squared standard deviations, up to which two loops agree; chi^2 with seven
degrees of freedom exceeds it once in 100 000 times, as many loops have very many pairs."""
BIAS = 0.5
"""Fraction of a step's deviation that may be systematic, such as a drift in scale; it adds up along
a chain, where the rest partly cancels."""
LEAST_WEIGHT = 0.1
"""Least robust weight of an accepted loop."""


@dataclass(frozen=True)
class Drift:
    """Drift of odometry from the first keyframe to each, in the frame of the world."""

    covariance: Float[Tensor, "n 7 7"]
    """Cumulative covariance of the independent errors of all steps."""
    bias: Float[Tensor, "n 7 7"]
    """Cumulative systematic error, one column for each number of the tangent."""

    def between(self, a: Int[Tensor, "l"], b: Int[Tensor, "l"]) -> Float[Tensor, "l 7 7"]:
        """Return the covariance of the drift between keyframes, in either order."""
        first = torch.minimum(a, b)
        last = torch.maximum(a, b)
        constant = self.bias[last] - self.bias[first]
        return self.covariance[last] - self.covariance[first] + constant @ constant.mT


def odometry_drift(T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses) -> Drift:
    """Compute drift along the steps between consecutive keyframes, each by its best trusted edge.

    A step without an edge gets the variance of the worst step with one. Raises GeogsError if no
    edge joins consecutive keyframes.
    """
    trusted = ~relative.is_loop & ((relative.target - relative.source).abs() == 1)
    edges = relative.select(trusted & (relative.information > 0).all(1))
    if not len(edges):
        raise GeogsError("No relative pose joins consecutive keyframes, so drift is unknown.")
    variance = 1 / edges.information
    order = torch.argsort(variance.sum(1), descending=True, stable=True)
    step = torch.minimum(edges.source, edges.target)
    chosen = variance[order[0]].repeat(len(T_cw) - 1, 1)
    for e in order.tolist():  # the best known comes last
        chosen[step[e]] = variance[e]
    carry = sim3_adjoint(se3_inverse(T_cw[1:]))
    steps = DRIFT * (carry * chosen[:, None]) @ carry.mT
    bias = BIAS * carry * chosen.sqrt()[:, None]
    none = steps.new_zeros(1, 7, 7)
    return Drift(torch.cat([none, steps.cumsum(0)]), torch.cat([none, bias.cumsum(0)]))


def cycle_errors(
    T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses
) -> tuple[Float[Tensor, "l l"], Float[Tensor, "l"]]:
    """Compute squared errors, in squared standard deviations, of the loops of a graph.

    Of each cycle of two loops with the odometry between them, and of each loop with the odometry
    between its ends.
    """
    loops = relative.select(relative.is_loop)
    drift = odometry_drift(T_cw, relative)
    back = se3_inverse(T_cw[loops.target])
    D = back @ loops.G @ T_cw[loops.source]
    carry = sim3_adjoint(back)
    own = (carry / loops.information.clamp(min=1e-12)[:, None]) @ carry.mT
    first = torch.minimum(loops.source, loops.target)
    second = torch.maximum(loops.source, loops.target)
    # All drifts are from the earlier keyframe to the later.
    turned = (loops.source > loops.target)[:, None, None]
    D = torch.where(turned, sim3_inverse(D), D)
    alone = _squares(sim3_log(D), own + drift.between(first, second))
    rows = []
    for a in range(len(loops)):
        here, there = first[a].expand_as(first), second[a].expand_as(second)
        between = drift.between(first, here) + drift.between(second, there)
        rows.append(_squares(sim3_log(D @ sim3_inverse(D[a])), own + own[a] + between))
    pairs = torch.stack(rows) if rows else alone.new_zeros(0, 0)
    return torch.maximum(pairs, pairs.mT), alone


def consistent_loops(T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses) -> Bool[Tensor, "e"]:
    """Mark the trusted edges and the largest set of mutually consistent loops.

    Loops that contradict the odometry are excluded. A set is grown from each loop, adding those
    first that agree with most. The set with most pairs of keyframes wins, then the one with the
    smallest errors. Loops in both directions between two keyframes count once.
    """
    keep = ~relative.is_loop
    if not bool(relative.is_loop.any()):
        return keep
    pairs, alone = cycle_errors(T_cw, relative)
    plausible = alone <= AGREEMENT
    agree = (pairs <= AGREEMENT) & plausible & plausible[:, None]
    loops = relative.select(relative.is_loop)
    ends = torch.stack([loops.source, loops.target], 1).sort(1).values.tolist()
    agreeing = agree.numpy()
    best: tuple[int, float] = (0, 0.0)
    winner: list[int] = []
    for seed in torch.nonzero(plausible)[:, 0].tolist():
        party = _grow(agreeing, seed)
        size = len({tuple(ends[a]) for a in party})
        score = size, -float(pairs[party][:, party].mean())
        if score > best:
            best = score
            winner = party
        if len(party) == int(plausible.sum()):
            break  # all agree, so all others grow to the same set
    if winner:
        keep[torch.nonzero(relative.is_loop)[:, 0][winner]] = True
    return keep


def _grow(agree: Bool[np.ndarray, "l l"], seed: int) -> list[int]:
    """Grow a mutually consistent set from a loop."""
    party = [seed]
    open_to = agree[seed].copy()
    open_to[seed] = False
    friends = agree @ open_to.astype(np.int32)
    while open_to.any():
        taken = int(np.where(open_to, friends, -1).argmax())
        party.append(taken)
        closed = open_to & ~agree[taken]
        closed[taken] = True
        open_to &= ~closed
        friends -= agree[:, closed].sum(1)
    return sorted(party)


def _squares(error: Float[Tensor, "l 7"], covariance: Float[Tensor, "l 7 7"]) -> Float[Tensor, "l"]:
    """Return squared Mahalanobis lengths."""
    return (error * torch.linalg.solve(covariance, error)).sum(-1)


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
    T_cw = question.T_cw
    relative = question.relative
    is_metric = question.is_metric
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
    known = sorted(correction.before)
    reference = 0
    after = {}
    scale = {}
    for id, now in sorted(T_cw.items()):
        while reference + 1 < len(known) and known[reference + 1] <= id:
            reference += 1
        of = known[reference]
        before = correction.before[of]
        s = correction.scale[of]
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
