"""Rigidly connected parts of a frame graph.

Matches on moving objects locate a camera as confidently as any others. Where people fill the view
for a moment, keyframes are linked by the scene before and after, and by the people meanwhile: each
part is correct by itself, but relative to the others its pose and scale are arbitrary. The keyframe
between two parts shows it: the cells that agree with the one do not agree with the other, so no
common structure links them.
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
"""Largest ratio to the median residual at which a cell agrees with a match."""
MIN_SUPPORT = 0.03
"""Least fraction of a keyframe's cells that agree with an edge for it to count."""
MIN_SHARED = 0.4
"""Least fraction of the cells that agree with one edge of a keyframe and also with another, for a
rigid connection of the two; of the edge with more such cells. In 24 correct starts the least was
0.45; in nine that were linked by people the largest was 0.35."""


def largest_part(
    keyframes: KeyframeSet,
    edges: Mapping[Pair, Edge],
    shared: float = MIN_SHARED,
    fixed: Collection[int] = (),
) -> frozenset[int]:
    """Return the largest rigidly connected set of keyframes; of several the earliest.

    ``edges`` exist both ways between the keyframes of each pair. Two of one keyframe are connected
    if they share at least a fraction ``shared`` of their agreeing cells; all edges of ``fixed``
    keyframes are connected.
    """
    support: dict[Pair, float] = {}
    joints: list[tuple[Pair, Pair]] = []
    directed = sorted(edges)
    source = torch.tensor([i for i, _ in directed], dtype=torch.long)
    for chunk in source_chunks(source, EDGES_TOGETHER):
        some = directed[chunk]
        of = source[chunk]
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
    """Return the connected component of each node; links to unknown nodes are ignored."""
    from scipy.sparse import coo_array  # not needed before a start
    from scipy.sparse.csgraph import connected_components

    if not nodes:
        return []
    number = {node: n for n, node in enumerate(nodes)}
    ends = [(number[a], number[b]) for a, b in links if a in number and b in number]
    index = np.array(ends, np.int64).reshape(-1, 2).T
    matrix = coo_array((np.ones(len(ends)), index), shape=(len(nodes), len(nodes)))
    return connected_components(matrix, directed=False)[1].tolist()
