"""Which loops agree with each other: a vote that comes before the adjustment.

A loop from keyframe i to j with measurement G claims that the world as drawn around i lies, as
drawn around j, at ``D = S_j^-1 G S_i``: the drift between the two, a similarity of the world. Two
true loops claim the same D, but for their noise and for what drifted between their first and
between their second ends (the cycle through both loops and the odometry between them). False loops
do not, unless they share a cause, such as two rooms that look alike; then the larger party is right
more often. Source: pairwise consistency maximisation (Mangelson et al. 2018), greedily.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.errors import GeogsError
from geogs.geometry.lie import se3_inverse, sim3_adjoint, sim3_inverse, sim3_log
from geogs.loop.pose_graph import RelativePoses


@dataclass(frozen=True)
class ConsistencyOptions:
    """When loops agree."""

    threshold: float = 24.3
    """Squared error, in squared standard deviations, up to which two loops agree; the 99.9th
    percentile of chi^2 with seven degrees of freedom."""
    drift: float = 9.0
    """Factor of the odometry's covariance: errors repeat from step to step, which no information
    of a single step tells."""
    support: int = 1
    """Pairs of keyframes that have to agree before any loop is believed."""


def drift_covariance(
    T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses
) -> Float[Tensor, "n 7 7"]:
    """Covariance of the drift from the first keyframe to each, in the frame of the world.

    Steps between consecutive keyframes count, the surest edge of each; a step that none covers is
    as unsure as the worst that is covered. The drift between keyframes a < b has the difference.
    Raises GeogsError if no edge joins consecutive keyframes.
    """
    n = len(T_cw)
    trusted = ~relative.is_loop & ((relative.target - relative.source).abs() == 1)
    edges = relative.select(trusted & (relative.information > 0).all(1))
    if not len(edges):
        raise GeogsError("No relative pose joins consecutive keyframes, so drift is unknown.")
    carry = sim3_adjoint(se3_inverse(T_cw[edges.target]))
    covariance = (carry / edges.information[:, None]) @ carry.mT
    # An edge's translation is as sure as its frame's, wherever the world's origin lies.
    unsure = (1 / edges.information).sum(1)
    step = torch.minimum(edges.source, edges.target)
    order = torch.argsort(unsure, descending=True, stable=True)
    steps = covariance[order[0]].repeat(max(n - 1, 0), 1, 1)
    for e in order.tolist():  # the surest comes last and stays
        steps[step[e]] = covariance[e]
    return torch.cat([steps.new_zeros(1, 7, 7), steps.cumsum(0)])


def cycle_errors(
    T_cw: Float[Tensor, "n 4 4"], relative: RelativePoses, drift: float
) -> tuple[Float[Tensor, "l l"], Float[Tensor, "l"]]:
    """Squared errors, in squared standard deviations, of the loops of a graph among themselves.

    Of each cycle of two loops with the odometry between them, and of each loop with the odometry
    between its ends; ``drift`` multiplies the odometry's covariance.
    """
    loops = relative.select(relative.is_loop)
    total = drift * drift_covariance(T_cw, relative)
    back = se3_inverse(T_cw[loops.target])
    D = back @ loops.G @ T_cw[loops.source]
    carry = sim3_adjoint(back)
    own = (carry / loops.information.clamp(min=1e-12)[:, None]) @ carry.mT
    first = torch.minimum(loops.source, loops.target)
    second = torch.maximum(loops.source, loops.target)
    # All claims run from the earlier keyframe to the later.
    turned = (loops.source > loops.target)[:, None, None]
    D = torch.where(turned, sim3_inverse(D), D)
    alone = _squares(sim3_log(D), own + total[second] - total[first])
    rows = []
    for a in range(len(loops)):
        between = _gap(total, first, first[a]) + _gap(total, second, second[a])
        rows.append(_squares(sim3_log(D @ sim3_inverse(D[a])), own + own[a] + between))
    pairs = torch.stack(rows) if rows else alone.new_zeros(0, 0)
    return torch.maximum(pairs, pairs.mT), alone


def consistent_loops(
    T_cw: Float[Tensor, "n 4 4"],
    relative: RelativePoses,
    options: ConsistencyOptions | None = None,
) -> Bool[Tensor, "e"]:
    """Marks the trusted edges and the largest party of loops of which every two agree.

    Loops that contradict the odometry stand outside. A party is grown from each loop, taking those
    first that agree with most; the one with most pairs of keyframes wins, then the one whose errors
    are least. Loops in both directions between two keyframes count once.
    """
    options = options or ConsistencyOptions()
    keep = ~relative.is_loop
    if not bool(relative.is_loop.any()):
        return keep
    pairs, alone = cycle_errors(T_cw, relative, options.drift)
    plausible = alone <= options.threshold
    agree = (pairs <= options.threshold) & plausible & plausible[:, None]
    loops = relative.select(relative.is_loop)
    ends = torch.stack([loops.source, loops.target], 1).sort(1).values.tolist()
    best: tuple[int, float] = (0, 0.0)
    winner: list[int] = []
    for seed in torch.nonzero(plausible)[:, 0].tolist():
        party = _grow(agree, seed)
        size = len({tuple(ends[a]) for a in party})
        score = size, -float(pairs[party][:, party].mean())
        if score > best:
            best, winner = score, party
    if best[0] >= options.support:
        keep[torch.nonzero(relative.is_loop)[:, 0][winner]] = True
    return keep


def _grow(agree: Bool[Tensor, "l l"], seed: int) -> list[int]:
    """A set around a loop of which every two agree."""
    party, open_to = [seed], agree[seed].clone()
    open_to[seed] = False
    while bool(open_to.any()):
        friends = (agree & open_to).sum(1)
        friends[~open_to] = -1
        taken = int(friends.argmax())
        party.append(taken)
        open_to &= agree[taken]
        open_to[taken] = False
    return sorted(party)


def _gap(total: Float[Tensor, "n 7 7"], a: Tensor, b: Tensor) -> Float[Tensor, "l 7 7"]:
    """Covariance of the drift between keyframes, in either order."""
    return total[torch.maximum(a, b)] - total[torch.minimum(a, b)]


def _squares(error: Float[Tensor, "l 7"], covariance: Float[Tensor, "l 7 7"]) -> Float[Tensor, "l"]:
    """Squared Mahalanobis lengths."""
    return (error * torch.linalg.solve(covariance, error)).sum(-1)
