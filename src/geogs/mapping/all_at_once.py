"""A map of many keyframes at once, where none was made of them on the way."""

import time
from collections.abc import Sequence

from geogs.depth.base import Progress, silent
from geogs.mapping.depth_schedule import group_size, search_depths, spread_order
from geogs.mapping.mapper import SEARCHED, Mapper


def map_all(
    mapper: Mapper,
    keyframe_ids: Sequence[int],
    progress: Progress = silent,
    seconds: float | None = None,
) -> None:
    """Give observed keyframes their depths, grow the map with all of them, and train it.

    An exception raised by ``progress`` keeps what there is by then. Of a limited time about a part
    ``SEARCHED`` is for depths, of keyframes evenly spread over all; those that get none are left
    out. Depths that there are already stay.
    """
    ids = [i for i in keyframe_ids if not mapper.views[i].has_depth]
    until = None
    if seconds is not None:
        ids, until = spread_order(ids), time.perf_counter() + SEARCHED * seconds
    # In groups that are as small as keeps all cores busy, so that an interruption is soon heard.
    search_depths(mapper, ids, lambda done: progress(SEARCHED * done), until, group_size())
    if not mapper.mapped:
        return
    mapper.check_depths()
    mapper.grow()
    steps = mapper.config.steps_at_once(len(keyframe_ids), mapper.keyframes.grid.on_gpu)
    if seconds is not None:  # but every keyframe is seen once
        affordable = int((1 - SEARCHED) * seconds / mapper.seconds_per_step())
        steps = min(steps, max(affordable, len(mapper.mapped)))
    mapper.train(steps, lambda done: progress(SEARCHED + (1 - SEARCHED) * done))
