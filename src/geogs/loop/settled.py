"""Revisited places at which a further search would be redundant."""

from collections.abc import Collection

import torch

from geogs.loop.constraints import between_positions, differences
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeSet
from geogs.world.loops import RelativePoses

REACH = 8
"""Distance in keyframes, summed over both ends, within which pairs near a settled one are settled,
too: the drift between them is a small part of that between its ends."""
RECENT = 64
"""Number of latest keyframes considered as later ends: more than are ever searched."""


def settled_pairs(
    segment: KeyframeSet,
    relative: RelativePoses,
    edges: Collection[Pair],
    min_gap: int,
    min_change: float,
) -> list[Pair]:
    """Return pairs of recent keyframes with older ones, earlier id first, whose motion is known.

    It is known from a loop whose relative poses, between ids, are within ``min_change`` (radians,
    fraction of the median depth, or of the scale) of the present poses, so that no keyframe would
    move by more; or from present or former matches of tracking between keyframes ``min_gap`` or
    more apart, to which the present poses are fitted.
    """
    ids = segment.ids
    if len(ids) <= min_gap:
        return []
    first_recent = ids[max(len(ids) - RECENT, 0)]
    relative = relative.select(torch.maximum(relative.source, relative.target) >= first_recent)
    places = between_positions(relative, ids)
    relative = relative.select((places.source - places.target).abs() >= min_gap)
    place = {k: n for n, k in enumerate(ids)}
    tracked = {
        (i, j) for i, j in edges if j >= first_recent and i < j and place[j] - place[i] >= min_gap
    }
    if not len(relative):
        return sorted(tracked)
    differs = differences(segment, relative) >= min_change
    changing = relative.select(relative.is_loop & differs)
    return sorted(tracked | ({*relative.pairs} - {*changing.pairs}))
