"""Keyframes that their images join.

Matches on what moves place a camera as surely as any others, and where people fill the view for a
moment, what was before and what comes after stand to each other anyhow. Images of one place tell:
they agree where poses and depths put them.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch

from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.matching.photometric_check import MIN_NCC, PhotometricCheck, correlation_at
from geogs.world.edges import Pair

ASKED = 64
"""Most edges across a gap that are checked, nearest in time first."""


def photometric_checks(
    graph: FrameGraph, directed: Sequence[Pair], static: bool = False
) -> list[PhotometricCheck]:
    """Photometric checks of the second keyframe of each pair at the depths of the first.

    ``static`` leaves out the cells that move.
    """
    keyframes, grey, found = graph.keyframes, graph.operator.grey, []
    poses = keyframes.relative_poses(directed)
    for (i, j), T_ji in zip(directed, poses, strict=True):
        source, target = keyframes[i], keyframes[j]
        information = source.information
        if static and source.moving is not None:
            information = torch.where(source.moving, 0.0, information)
        images = grey(source.encoded), grey(target.encoded)
        depth = source.inverse_depth
        found.append(correlation_at(keyframes.grid, *images, T_ji, depth, information))
    return [PhotometricCheck.of(f) for f in torch.stack(found).cpu()] if found else []


def largest_group(graph: FrameGraph, ids: Sequence[int]) -> float:
    """Fraction of some keyframes, earliest first, in the largest group that images join.

    Neighbours in time are joined where one of the two passes the photometric check at the depths of
    the other, for something may cover one of them, or where there is too little texture for it;
    else by other edges across the gap that pass.
    """
    from scipy.sparse import coo_array  # a start has no need of it
    from scipy.sparse.csgraph import connected_components

    pairs = list(pairwise(ids))
    joined = _agreeing(graph, pairs, is_expected=True)
    order = {k: n for n, k in enumerate(ids)}
    known = [(i, j) for i, j in graph.pairs if i in order and j in order]
    for a, b in [pair for pair in pairs if pair not in joined]:
        across = [(i, j) for i, j in known if order[i] <= order[a] and order[b] <= order[j]]
        across.sort(key=lambda pair: order[pair[1]] - order[pair[0]])
        joined |= _agreeing(graph, across[:ASKED], is_expected=False)
    edges = np.array([(order[i], order[j]) for i, j in joined]).reshape(-1, 2)
    size = len(ids)
    links = coo_array((np.ones(len(edges)), edges.T), shape=(size, size))
    _, group = connected_components(links, directed=False)
    return float(np.bincount(group).max(initial=0)) / max(size, 1)


def _agreeing(graph: FrameGraph, pairs: Sequence[Pair], is_expected: bool) -> set[Pair]:
    """Those of which one keyframe passes the check at the depths of the other."""
    there = photometric_checks(graph, pairs, static=True)
    agreeing = {p for p, c in zip(pairs, there, strict=True) if c.passes(MIN_NCC, is_expected)}
    rest = [pair for pair in pairs if pair not in agreeing]
    back = photometric_checks(graph, [(j, i) for i, j in rest], static=True)
    return agreeing | {p for p, c in zip(rest, back, strict=True) if c.passes(MIN_NCC, is_expected)}
