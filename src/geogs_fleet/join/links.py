"""Links: keyframes of two parts with a common view, found by appearance and verified like loops."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.application.results.saved_result import SavedResult
from geogs.config import Config, LoopConfig
from geogs.geometry.camera import Camera
from geogs.loop.constraints import of_loop
from geogs.loop.dense_check import dense_check
from geogs.loop.retrieval import AppearanceIndex
from geogs.loop.search import MIN_SCORE, SUPPRESSION
from geogs.loop.verification import FeatureView, TwoViewVerifier
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.flow.operator_choice import build_operator
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet, KeyframeTable
from geogs.world.loops import Loop, RelativePoses
from geogs_fleet.join.part import Node, Part, PartViews, image_of, opened
from geogs_fleet.join.records import read_record

Candidates = dict[tuple[int, int], list[tuple[int, int]]]
"""Indices of keyframes in two parts, by the numbers of these, the earlier first."""


@dataclass(frozen=True)
class Link:
    """A pair of keyframes of two parts with a common view."""

    first: Node
    second: Node
    S_ji: Float[Tensor, "4 4"]
    """Sim(3) from the first camera, in its part's unit, to the second, in its part's unit."""
    matched: float
    """Fraction of the cells whose flow agrees."""
    relative: RelativePoses
    """Relative poses with information, between 0 (the first) and 1, in both directions."""


def candidates(parts: Iterable[PartViews], config: LoopConfig) -> Candidates:
    """Pairs of keyframes of different parts that look alike, most alike first.

    Each keyframe is compared with those of all parts before its own. Within two parts, a pair of
    keyframes rules out others whose ends together lie within ``SUPPRESSION`` keyframes of its own.
    Parts are read one at a time; only the index stays in memory.
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


@on_one_torch_thread
def links_of(
    numbers: tuple[int, int],
    parts: tuple[Part, Part],
    files: tuple[Path, Path],
    pairs: Sequence[tuple[int, int]],
    camera: Camera,
    config: Config,
) -> list[Link]:
    """Verify pairs of keyframes of two parts, by features with depth, then by dense flow.

    ``numbers`` are the parts' own, ``files`` those of their views; ``pairs`` are indices in them.
    """
    grid = SampleGrid(camera)
    verifier = TwoViewVerifier(camera)
    views = [read_record(PartViews, path) for path in files]
    wanted: list[tuple[int, int, Tensor, float, int]] = []
    for a, b in pairs:
        one, other = (_seen(grid, v, n) for v, n in zip(views, (a, b), strict=True))
        view = verifier.verify(one, other)
        if view.accepted and view.is_metric and view.T_ji is not None:
            wanted.append((a, b, view.T_ji, view.scale or 1.0, view.inliers))
    if not wanted:
        return []
    operator = build_operator(config.tracking, grid)
    store = KeyframeTable.on(grid, operator.encode)
    segments = store.new_set(), store.new_set()
    places = sorted({w[0] for w in wanted}), sorted({w[1] for w in wanted})
    loaded = [
        loaded_keyframes(segment, operator, opened(part), v, some)
        for segment, part, v, some in zip(segments, parts, views, places, strict=True)
    ]
    found = []
    for a, b, T_ji, scale, inliers in wanted:
        first, second = loaded[0][a], loaded[1][b]
        check = dense_check(grid, operator, first, second, T_ji, scale)
        if not check.accepted or check.T_ji is None or check.there is None or check.back is None:
            continue
        loop = Loop(
            first.id,
            second.id,
            "appearance",
            check.T_ji,
            check.scale,
            inliers,
            check.matched,
            check.there,
            check.back,
        )
        relative = of_loop(store, loop)
        source = (relative.source != first.id).long()
        target = (relative.target != first.id).long()
        if len(relative):
            nodes = (numbers[0], a), (numbers[1], b)
            ends = replace(relative, source=source, target=target)
            found.append(Link(*nodes, loop.S_ji.cpu(), check.matched, ends))
    return found


def loaded_keyframes(
    segment: KeyframeSet,
    operator: FlowOperator,
    result: SavedResult,
    views: PartViews,
    places: Iterable[int],
    T_cw: Float[Tensor, "n 4 4"] | None = None,
) -> dict[int, Keyframe]:
    """Add keyframes of a part to a segment; return them by their index in the part.

    Their poses are ``T_cw``, those of all keyframes in another world, if given; depths are in the
    unit of the part.
    """
    grid = segment.grid
    loaded = {}
    for n in places:
        image = image_of(result, n, grid.camera)
        pose = torch.from_numpy(views.T_cw[n]) if T_cw is None else T_cw[n]
        time = float(views.timestamp[n])
        keyframe = segment.add(n, time, image, operator.encode(image), pose)
        keyframe.inverse_depth = torch.from_numpy(views.inverse_depth[n]).to(grid.device)
        keyframe.information = torch.from_numpy(views.information[n]).to(grid.device)
        loaded[n] = keyframe
    return loaded


def _seen(grid: SampleGrid, views: PartViews, n: int) -> FeatureView:
    inverse, information = (
        torch.from_numpy(x[n]) for x in (views.inverse_depth, views.information)
    )
    return FeatureView.of(grid, inverse, information, views.features[n])


def _thinned(scored: list[tuple[float, int, int]], reach: int) -> list[tuple[int, int]]:
    kept: list[tuple[int, int]] = []
    for _, a, b in sorted(scored, key=lambda s: (-s[0], s[1], s[2])):
        if all(abs(a - c) + abs(b - d) > reach for c, d in kept):
            kept.append((a, b))
    return kept
