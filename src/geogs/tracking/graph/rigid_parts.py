"""Parts of a frame graph, each held together by one rigid structure.

Matches on what moves place a camera as surely as any others. Where people fill the view for a
moment, keyframes hang together by the scene before and after, and by the people meanwhile: each
part is right by itself, but to the others it stands anyhow, in pose and in scale. The keyframe
between two parts tells: its cells that agree with the one are not those that agree with the other,
so no structure hands anything on.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch

from geogs.bundle.problem import source_chunks
from geogs.tracking.graph.dynamic_cells import EDGES_TOGETHER, relative_residuals
from geogs.world.edges import Edge, Pair
from geogs.world.keyframes import KeyframeSet

MAX_RESIDUAL = 3.0
"""Multiples of the usual residual up to which a cell agrees with a match."""
MIN_SUPPORT = 0.03
"""Least fraction of a keyframe's cells that agree with an edge for it to hold anything."""
MIN_SHARED = 0.4
"""Least fraction of a keyframe's cells that agree with an edge which agree with another one, too,
for one structure to hold both; of that edge with which more agree. Of 24 starts that were right the
least was 0.45; of nine that people in between held together 0.35 the most."""


def largest_part(
    keyframes: KeyframeSet,
    edges: Mapping[Pair, Edge],
    shared: float = MIN_SHARED,
    fixed: Collection[int] = (),
) -> frozenset[int]:
    """The most keyframes that one structure holds together, of several such parts the earliest.

    ``edges`` lead both ways between the keyframes of each pair; two of one keyframe are held by one
    structure where so large a part of the cells that agree with either is ``shared``, and all of
    keyframes that are ``fixed``.
    """
    support: dict[Pair, float] = {}
    joints: list[tuple[Pair, Pair]] = []
    directed = sorted(edges)
    source = torch.tensor([i for i, _ in directed], dtype=torch.long)
    for chunk in source_chunks(source, EDGES_TOGETHER):
        some, of = directed[chunk], source[chunk]
        ratio, _, static = relative_residuals(keyframes, edges, some)
        agrees = ((ratio < MAX_RESIDUAL) & static).float()
        common = (agrees @ agrees.mT).cpu()
        count = common.diagonal()
        is_joint = common >= shared * torch.maximum(count, count[:, None])
        is_joint &= of == of[:, None]
        joints += [(some[a], some[b]) for a, b in is_joint.triu(1).nonzero().tolist()]
        support.update(zip(some, count.tolist(), strict=True))
    least = MIN_SUPPORT * keyframes.grid.size
    holding = [p for p in support if p[0] < p[1] and min(support[p], support[p[::-1]]) >= least]
    links = [(min(e, e[::-1]), min(f, f[::-1])) for e, f in joints]
    links += pairwise(p for p in holding if p[0] in fixed or p[1] in fixed)
    members: dict[int, set[int]] = {}
    for pair, part in zip(holding, _components(holding, links), strict=True):
        members.setdefault(part, set()).update(pair)
    largest = max(members.values(), key=lambda part: (len(part), -min(part)), default=set[int]())
    return frozenset(largest)


def _components(nodes: Sequence[Pair], links: Sequence[tuple[Pair, Pair]]) -> list[int]:
    """The number of the connected part of each node; links of what is no node join nothing."""
    from scipy.sparse import coo_array  # no frame before a start has need of it
    from scipy.sparse.csgraph import connected_components

    if not nodes:
        return []
    number = {node: n for n, node in enumerate(nodes)}
    ends = [(number[a], number[b]) for a, b in links if a in number and b in number]
    index = np.array(ends, np.int64).reshape(-1, 2).T
    matrix = coo_array((np.ones(len(ends)), index), shape=(len(nodes), len(nodes)))
    return connected_components(matrix, directed=False)[1].tolist()
