"""Frame and unit of every part: agreement of the links of two parts, and connected parts."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse, sim3_inverse
from geogs.loop.constraints import AGREEING_LOOPS, JOIN_TOLERANCE, disagreement
from geogs_fleet.join.links import Link
from geogs_fleet.join.part import PartViews


@dataclass(frozen=True)
class Gauge:
    """The parts of one world."""

    world: dict[int, Float[Tensor, "4 4"]]
    """Sim(3) from the joint world to that of each part, by the part's number."""
    links: tuple[Link, ...]
    """Links between parts of the world that agree with it."""

    @property
    def parts(self) -> list[int]:
        """Numbers of the parts, ascending."""
        return sorted(self.world)

    @property
    def linked(self) -> dict[int, list[int]]:
        """Parts to which each part is linked, ascending."""
        linked: dict[int, set[int]] = {n: set() for n in self.parts}
        for link in self.links:
            linked[link.first[0]].add(link.second[0])
            linked[link.second[0]].add(link.first[0])
        return {n: sorted(others) for n, others in linked.items()}


_Tie = tuple[Float[Tensor, "4 4"], list[Link]]
"""Sim(3) from the world of a part to that of another, and the links that agree on it."""


def common_gauge(parts: Sequence[PartViews], links: Sequence[Link]) -> Gauge:
    """The largest world that agreeing links make of the parts; its first part keeps its own frame.

    Two parts are tied if enough of their links agree, like segments of a run. Ties with most links
    are taken first (a maximum spanning tree); ties that contradict those are left out.
    """
    ties = _ties(parts, links)
    group = list(range(len(parts)))
    tree: dict[int, list[tuple[int, Tensor]]] = defaultdict(list)
    for (a, b), (S, _) in sorted(ties.items(), key=lambda t: (-len(t[1][1]), t[0])):
        if group[a] != group[b]:
            tree[a].append((b, S))
            tree[b].append((a, sim3_inverse(S)))
            group = [group[a] if g == group[b] else g for g in group]
    sizes = {g: sum(len(parts[n].T_cw) for n in range(len(parts)) if group[n] == g) for g in group}
    largest = max(sizes, key=lambda g: (sizes[g], -group.index(g)))
    root = group.index(largest)
    world = {root: torch.eye(4, dtype=torch.float64)}
    left = [root]
    while left:
        here = left.pop()
        for there, S in tree[here]:
            if there not in world:
                world[there] = S @ world[here]
                left.append(there)
    kept = [
        link
        for (a, b), (_, agreeing) in ties.items()
        if a in world and b in world
        for link in agreeing
        if _agrees(parts, link, world[b] @ sim3_inverse(world[a]), 2 * JOIN_TOLERANCE)
    ]
    return Gauge(world, tuple(kept))


def _ties(parts: Sequence[PartViews], links: Sequence[Link]) -> dict[tuple[int, int], _Tie]:
    between: dict[tuple[int, int], list[Link]] = defaultdict(list)
    for link in links:
        between[link.first[0], link.second[0]].append(link)
    ties = {}
    for pair, some in sorted(between.items()):
        parties = []
        for link in some:
            S = claim(parts, link)
            agreeing = [o for o in some if _agrees(parts, o, S, JOIN_TOLERANCE)]
            parties.append((len(agreeing), sum(o.matched for o in agreeing), S, agreeing))
        size, _, S, agreeing = max(parties, key=lambda p: p[:2])
        if size >= AGREEING_LOOPS:
            ties[pair] = (S, agreeing)
    return ties


def claim(parts: Sequence[PartViews], link: Link) -> Float[Tensor, "4 4"]:
    """Sim(3) from the world of the first part to that of the second, according to a link."""
    first, second = (torch.from_numpy(parts[p].T_cw[n]) for p, n in (link.first, link.second))
    return se3_inverse(second) @ link.S_ji @ first


def _agrees(
    parts: Sequence[PartViews], link: Link, S: Float[Tensor, "4 4"], tolerance: float
) -> bool:
    """Whether a link agrees with a Sim(3) between the worlds."""
    part, n = link.second
    T = torch.from_numpy(parts[part].T_cw[n])
    depth = torch.tensor(parts[part].median_depth[n])
    return float(disagreement(T @ claim(parts, link), T @ S, depth)) < tolerance
