"""Which keyframes of different parts look alike: the shared index."""

from collections import defaultdict
from collections.abc import Iterable

from geogs.config import LoopConfig
from geogs.loop.retrieval import AppearanceIndex
from geogs.loop.search import MIN_SCORE, SUPPRESSION
from geogs_fleet.join.part import PartViews

Candidates = dict[tuple[int, int], list[tuple[int, int]]]
"""By the numbers of two parts, the earlier first: places of keyframes in the one and the other."""


def candidates(parts: Iterable[PartViews], config: LoopConfig) -> Candidates:
    """Pairs of keyframes of different parts that look alike, most alike first.

    Each keyframe is compared with those of all parts before its own. Of a pair of parts, a pair of
    keyframes rules out others whose ends together lie within ``SUPPRESSION`` keyframes of its own.
    Parts are looked at one at a time; what stays in memory is the index.
    """
    index = AppearanceIndex()
    names: list[tuple[int, int]] = []
    found: dict[tuple[int, int], list[tuple[float, int, int]]] = defaultdict(list)
    for number, part in enumerate(parts):
        for place, features in enumerate(part.features if number else ()):
            for alike in index.query(features, (), config.appearance):
                if alike.score >= MIN_SCORE:
                    other, theirs = names[alike.keyframe]
                    found[other, number].append((alike.score, theirs, place))
        for place, features in enumerate(part.features):
            index.add(len(names), features)
            names.append((number, place))
    return {pair: _thinned(scored, SUPPRESSION) for pair, scored in sorted(found.items())}


def _thinned(scored: list[tuple[float, int, int]], reach: int) -> list[tuple[int, int]]:
    kept: list[tuple[int, int]] = []
    for _, a, b in sorted(scored, key=lambda s: (-s[0], s[1], s[2])):
        if all(abs(a - c) + abs(b - d) > reach for c, d in kept):
            kept.append((a, b))
    return kept
