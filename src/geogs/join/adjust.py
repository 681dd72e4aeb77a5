"""Bundle adjustment over the overlaps, a part at a time: its keyframes move, those around stay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.base import BundleOptions
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.join.gauge import Gauge
from geogs.join.graph import Placement
from geogs.join.links import loaded_keyframes
from geogs.join.part import Part, PartViews
from geogs.join.workers import Workers
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.store import KeyframeStore, Segment
from geogs.loop.global_bundle import MATCHED_TOGETHER, SMALL_STEP
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.flow.select import build_operator
from geogs.tracking.graph import FrameGraph
from geogs.tracking.proximity import Pair, proximity_pairs

SWEEPS = 2
"""Times that every part is adjusted; the first brings most."""
ROUNDS = 2
"""Measurements of each pair, from poses that become better."""


@dataclass(frozen=True)
class Neighbour:
    """A part as the adjustment of another sees it."""

    part: Part
    views: Path
    placement: Placement


@dataclass(frozen=True)
class AdjustJob:
    """A part to be adjusted among its neighbours."""

    own: Neighbour
    others: tuple[Neighbour, ...]
    camera: Camera
    config: Config


def adjusted(
    parts: Sequence[Part],
    files: Sequence[Path],
    placements: Mapping[int, Placement],
    gauge: Gauge,
    camera: Camera,
    config: Config,
    workers: Workers,
) -> dict[int, Placement]:
    """The keyframes of a world after each part was adjusted among those linked to it.

    Parts without a link between them are adjusted side by side, the others one after the other, so
    that each sees where its neighbours have come to.
    """
    beside = {n: set[int]() for n in gauge.parts}
    for link in gauge.links:
        beside[link.first[0]].add(link.second[0])
        beside[link.second[0]].add(link.first[0])
    now = dict(placements)

    def seen(n: int) -> Neighbour:
        return Neighbour(parts[n], files[n], now[n])

    for colour in SWEEPS * _colours(beside):
        jobs = [
            AdjustJob(seen(n), tuple(seen(m) for m in sorted(beside[n])), camera, config)
            for n in colour
        ]
        now |= zip(colour, workers.map("adjusting", adjust_part, jobs), strict=True)
    return now


def _colours(beside: Mapping[int, set[int]]) -> list[list[int]]:
    """Groups of parts that are not beside each other, greedily."""
    groups: list[list[int]] = []
    for n in sorted(beside, key=lambda n: (-len(beside[n]), n)):
        free = (group for group in groups if beside[n].isdisjoint(group))
        group = next(free, None)
        if group is None:
            groups.append([n])
        else:
            group.append(n)
    return [sorted(group) for group in groups]


@on_one_torch_thread
def adjust_part(job: AdjustJob) -> Placement:
    """Poses of a part's keyframes by all matches among them and with those of its neighbours."""
    c, grid = job.config.tracking, SampleGrid(job.camera)
    operator = build_operator(c, grid)
    segment = KeyframeStore(grid, operator.encode).new_segment()
    own = _load(job.own, segment, operator, None)
    around = _centres(job.own)
    others = [id for other in job.others for id in _load(other, segment, operator, around)]
    limit = c.global_distance * max(grid.camera.width, grid.camera.height)
    among = proximity_pairs(
        segment, own, own, [], c.radius, c.global_suppression, limit, c.global_pairs * len(own)
    )
    beyond: list[Pair] = []
    if others:
        beyond = proximity_pairs(
            segment, others, own, [], 0, c.global_suppression, limit, c.global_pairs * len(own)
        )
    graph, pairs = FrameGraph(segment, operator), sorted([*among, *beyond])
    options = BundleOptions(iterations=c.global_iterations, huber=c.huber, tolerance=SMALL_STEP)
    free = own if beyond else own[1:]
    batch = MATCHED_TOGETHER[grid.on_gpu]
    for _ in range(ROUNDS if pairs else 0):
        stale = sorted(graph.stale(pairs, c.global_remeasure))
        for start in range(0, len(stale), batch):
            graph.measure(stale[start : start + batch], packed=True)
        graph.adjust(list(graph.edges), free, own, options)
        graph.judge_moving(set(own), c.moving)
    return replace(job.own.placement, T_cw=segment.poses(own).double())


def _load(
    neighbour: Neighbour,
    segment: Segment,
    operator: FlowOperator,
    around: Float[np.ndarray, "n 3"] | None,
) -> list[int]:
    """Ids of the keyframes of a part, or of those near some places, put into a segment."""
    views, placement = PartViews.load(neighbour.views), neighbour.placement
    places = list(range(len(views.T_cw)))
    if around is not None:
        centre = _centres(neighbour)
        depth = views.median_depth / placement.scale.numpy()
        away = np.linalg.norm(centre[:, None] - around, axis=2).min(axis=1)
        places = [n for n in places if away[n] < depth[n]]
    loaded = loaded_keyframes(
        segment, operator, neighbour.part, views, places, placement.T_cw, placement.scale.tolist()
    )
    return [keyframe.id for keyframe in loaded.values()]


def _centres(neighbour: Neighbour) -> Float[np.ndarray, "n 3"]:
    T_wc: Tensor = se3_inverse(neighbour.placement.T_cw)
    return np.asarray(T_wc[:, :3, 3].numpy())
