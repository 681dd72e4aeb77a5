"""Mapping of many keyframes at once, in an order and in groups that suit the time budget."""

import time
from collections.abc import Callable, Sequence

import numpy as np

from geogs.depth.depth_engine import Progress, silent
from geogs.mapping.coverage import coverage_order, scene_points, sightings
from geogs.mapping.keyframe_depths import tracked_depth
from geogs.mapping.mapper import SEARCHED, Mapper
from geogs.mapping.training.full import seconds_per_step
from geogs.threads import worker_count

# Most and least keyframes whose depths are searched in one go.
_AT_ONCE, _FIRST = 16, 4
# Mean newness of its rays above which a keyframe gets a depth.
_NEWNESS = 0.1
# Scene points per keyframe that measure it; least number of them in all.
_POINTS_EACH, _POINTS = 4, 1000


def map_all(
    mapper: Mapper,
    keyframe_ids: Sequence[int],
    progress: Progress = silent,
    time_budget: float | None = None,
) -> None:
    """Search the depths of observed keyframes, grow the map with them, and train it.

    Keyframes that add hardly any new views (:func:`covering`) get no depth; they are only matched
    with. After an exception raised by ``progress`` the result so far stays. About the fraction
    ``SEARCHED`` of a time budget, in seconds, is for depths, of keyframes evenly spread over all;
    those without depth are left out. Existing depths stay.
    """
    ids = [i for i in covering(mapper, keyframe_ids) if not mapper.views[i].has_depth]
    until = None
    if time_budget is not None:
        ids = spread_order(ids)
        until = time.perf_counter() + SEARCHED * time_budget
    # In groups just large enough for all cores, so that an interruption takes effect soon.
    search_depths(mapper, ids, lambda done: progress(SEARCHED * done), until, group_size())
    if not mapper.table.mapped:
        return
    mapper.check_depths()
    mapper.grow()
    steps = mapper.config.steps_at_once(len(keyframe_ids), mapper.keyframes.grid.on_gpu)
    if time_budget is not None:  # but every keyframe is seen once
        seconds = seconds_per_step(mapper.table, mapper.views, mapper.trainer, mapper.config)
        affordable = int((1 - SEARCHED) * time_budget / seconds)
        steps = min(steps, max(affordable, len(mapper.table.mapped)))
    mapper.train(steps, lambda done: progress(SEARCHED + (1 - SEARCHED) * done))


def covering(mapper: Mapper, keyframe_ids: Sequence[int]) -> list[int]:
    """Keyframes that cover the scene as well as all the given ones, in order.

    Where a camera lingers or returns, others see the same points along nearly the same rays.
    """
    views = [mapper.views[i] for i in keyframe_ids]
    camera = mapper.cameras.render
    if not views:
        return []
    T_cw = np.stack([view.T_cw.numpy() for view in views])
    typical = np.array([tracked_depth(view.keyframe) for view in views])
    most = max(_POINTS, _POINTS_EACH * len(views))
    points = scene_points(T_cw, camera, typical, np.random.default_rng(0), most)
    seen = sightings(T_cw, camera, typical, points)
    chosen = coverage_order(seen, np.ones(len(views)), _NEWNESS)
    return sorted(keyframe_ids[n] for n in chosen)


def spread_order(items: Sequence[int]) -> list[int]:
    """Reorder items so that for any n the first n are spread evenly over all of them.

    The first, then the middle one, then those at the quarters: by the reversed bits of the index.
    """
    bits = max(len(items) - 1, 1).bit_length()
    places = sorted(range(len(items)), key=lambda i: int(f"{i:0{bits}b}"[::-1], 2))
    return [items[i] for i in places]


def group_size() -> int:
    """Keyframes whose depths are searched in one go where time is short."""
    return max(_FIRST, worker_count())


def search_depths(
    mapper: Mapper,
    keyframe_ids: Sequence[int],
    progress: Callable[[float], None],
    until: float | None = None,
    at_once: int = _AT_ONCE,
) -> None:
    """Search the depths of keyframes in groups of ``at_once``; those with a depth are mapped.

    After an exception raised by ``progress`` finished groups stay. With ``until``, a time of
    ``time.perf_counter``, groups are small, and the rest is left without depth as soon as the next
    one would take longer; the first group is always done.
    """
    ids = list(keyframe_ids)
    done = 0
    size = at_once if until is None else group_size()
    while done < len(ids) and size > 0:
        start = time.perf_counter()
        group = ids[done : done + size]
        mapper.search_depths(group)
        done += len(group)
        if until is not None:
            float(mapper.views[group[-1]].typical_depth)  # waits for a GPU
            size = _affordable(start, len(group), until)
        progress(done / len(ids))


def _affordable(start: float, searched: int, until: float) -> int:
    """Number of keyframes to search next, at the pace since ``start``; 0 if it is too small.

    Half of those that fit into the time, as the pace may change.
    """
    now = time.perf_counter()
    least = worker_count()
    count = int((until - now) * searched / max(now - start, 1e-9))
    return 0 if count < least else max(least, min(count // 2, _AT_ONCE))
