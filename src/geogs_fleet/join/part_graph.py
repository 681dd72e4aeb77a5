"""All keyframes of one world in one Sim(3) pose graph: stiff within each part, joined by links."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.geometry.lie import se3_inverse, sim3_scale
from geogs.loop.constraints import joined
from geogs.loop.pose_graph import PoseGraph, solve
from geogs.world.loops import RelativePoses
from geogs_fleet.join.gauge import Gauge
from geogs_fleet.join.part import PartViews

STEP = 1e-3
"""Standard deviation between neighbouring keyframes after a part's own adjustment: radians,
fraction of the depth, and of the scale."""
STEPS = (1, 2, 4)
"""Differences in index of keyframes that are tied to each other."""
NEAREST = 4
"""Number of keyframes, nearest in position and viewing direction, to which each is tied, too."""


@dataclass(frozen=True)
class Placement:
    """Poses of a part's keyframes in the joint world."""

    T_cw: Float[Tensor, "n 4 4"]
    """Joint world to camera, float64."""
    scale: Float[Tensor, "n"]
    """Divisor of the lengths around each keyframe, from the part's unit to the joint one."""

    def similarities(self, T_before: Float[np.ndarray, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
        """Sim(3) from the part's world to the joint one, at each keyframe."""
        T = torch.from_numpy(T_before).clone()
        T[:, :3] /= self.scale[:, None, None]
        T[:, 3, 3] = 1
        return se3_inverse(self.T_cw) @ T


def placed(parts: Sequence[PartViews], gauge: Gauge) -> dict[int, Placement]:
    """Place the keyframes of every part of a world, by the part's number, by the pose graph.

    The first keyframe of the first part is fixed.
    """
    numbers = gauge.parts
    counts = [len(parts[n].T_cw) for n in numbers]
    first = {n: sum(counts[:place]) for place, n in enumerate(numbers)}
    start = torch.cat([torch.from_numpy(parts[n].T_cw) @ gauge.world[n] for n in numbers])
    ties = [_stiff(parts[n], first[n]) for n in numbers]
    relative = joined([*ties, *_linked(gauge, first)])
    fixed = torch.arange(len(start)) == 0
    S = solve(PoseGraph(start, relative, fixed)).S
    scale = sim3_scale(S)
    after = S / scale[:, None, None]
    after[:, 3] = S[:, 3]
    ends = {n: first[n] + len(parts[n].T_cw) for n in numbers}
    return {n: Placement(*(x[first[n] : ends[n]] for x in (after, scale))) for n in numbers}


def _linked(gauge: Gauge, first: Mapping[int, int]) -> list[RelativePoses]:
    found = []
    for link in gauge.links:
        ends = torch.tensor([first[p] + n for p, n in (link.first, link.second)])
        r = link.relative
        loops = torch.ones_like(r.is_loop)
        found.append(RelativePoses(ends[r.source], ends[r.target], r.G, r.information, loops))
    return found


def _stiff(part: PartViews, offset: int) -> RelativePoses:
    """Relative poses of a part's own keyframes."""
    pairs = _pairs(part)
    T = torch.from_numpy(part.T_cw)
    source, target = pairs.unbind(1)
    depth = torch.from_numpy(part.median_depth)[target]
    information = torch.full((len(pairs), 7), STEP**-2, dtype=torch.float64)
    information[:, :3] /= depth[:, None].square()
    G = T[target] @ se3_inverse(T[source])
    trusted = torch.zeros(len(pairs), dtype=torch.bool)
    return RelativePoses(source + offset, target + offset, G, information, trusted)


def _pairs(part: PartViews) -> Int[Tensor, "e 2"]:
    """Pairs of keyframes near each other in time, or in pose."""
    n = len(part.T_cw)
    pairs = {(a, a + step) for step in STEPS for a in range(n - step)}
    rotation = part.T_cw[:, :3, :3]
    centre = -np.einsum("nji,nj->ni", rotation, part.T_cw[:, :3, 3])
    ahead = rotation[:, 2]
    for a in range(n):
        away = np.linalg.norm(centre - centre[a], axis=1) / part.median_depth[a]
        away += 1 - ahead @ ahead[a]
        pairs |= {(min(a, b), max(a, b)) for b in np.argsort(away)[1 : 1 + NEAREST].tolist()}
    found = sorted(p for p in pairs if p[0] != p[1])
    return torch.tensor(found, dtype=torch.long).reshape(-1, 2)
