"""Depths of images with known poses, and the training after them, within a time budget."""

import time
from collections.abc import Callable

import numpy as np

from geogs.config import SearchConfig
from geogs.mapping import known_poses as known
from geogs.mapping.first_look import SmallImage, first_points
from geogs.mapping.map_all import group_size, search_depths, spread_order
from geogs.mapping.mapper import Mapper
from geogs.mapping.time_budget import TimeBudget
from geogs.mapping.training.full import seconds_per_step

More = Callable[[Callable[[], int]], None]
"""Adds further images, at most as many as its argument returns when it is called."""

# Steps from which on their mean time predicts that of further ones.
_ENOUGH_STEPS = 100


class PosedMapping:
    """Searches depths of images with known poses, once or twice, and trains, in a time budget."""

    def __init__(self, mapper: Mapper, search: SearchConfig, budget: TimeBudget, seed: int) -> None:
        self._mapper = mapper
        self._search = search
        self._budget = budget
        self._random = np.random.default_rng(seed)

    def first_points(self, progress: Callable[[float], None]) -> np.ndarray:
        """Points of the scene from a few small images. Raises InputError without any."""
        views = list(self._mapper.views.values())

        def image_at(index: int) -> SmallImage:
            mask = views[index].mask
            return views[index].keyframe.image, None if mask is None else mask.cpu().numpy()

        poses = [view.view_pose for view in views]
        return first_points(poses, image_at, self._mapper.cameras.working, progress)

    def search(
        self,
        points: np.ndarray,
        progress: Callable[[float], None],
        more: More | None,
        in_order: bool,
    ) -> None:
        """Search the depths of the images; if time allows, again in the ranges of the first result.

        If time is short, fewer images are searched: the first ones if ``in_order``, else evenly
        spread ones.
        """
        search = self._search
        mapper = self._mapper
        budget = self._budget
        camera = mapper.cameras.working
        known.expect_depths(mapper.views.values(), points, camera)
        part = 0.5 if search.repeat else 1.0
        if more is not None and budget.training_end is not None:
            searched, seconds = self._try_depths()
            more(lambda: budget.further_views(search, searched, seconds))
            new = [v for v in mapper.views.values() if v.row.search is None]
            known.expect_depths(new, points, camera)
        ids = [*mapper.views] if in_order else spread_order([*mapper.views])
        wanted = budget.views or len(ids)
        start = time.perf_counter()
        end = budget.training_end
        before = len(mapper.table.mapped)
        until = None if end is None else start + search.depth_ratio * (end - start)
        if until is not None:  # images beyond those in the budget take time in the mesh, too
            until -= budget.output_cost.a_view * group_size()
        order = [i for i in ids if not mapper.views[i].has_depth]
        search_depths(mapper, order, lambda f: progress(part * f), until)
        now = time.perf_counter()
        mapped = mapper.table.mapped
        again = (now - start) * len(mapped) / max(len(mapped) - before, 1)
        affordable = end is None or 3 * again < end - now
        if search.repeat and affordable and len(mapped) >= wanted:
            views = [mapper.views[i] for i in mapped]
            mapper.check_depths()
            found = known.dense_points(views, mapper.cameras.render, self._random)
            if len(found) >= known.FEWEST_POINTS:
                known.expect_depths(views, found, camera)
            search_depths(mapper, mapped, lambda f: progress(part + part * f))
        budget.views = len(mapper.table.mapped)
        progress(1.0)

    def train(self, progress: Callable[[float], None], goes_on: bool = False) -> None:
        """Train as many steps as time allows, or the usual number without a budget."""
        end = self._budget.training_end
        self._mapper.train(self._steps(end, goes_on), progress, end, goes_on)

    def _steps(self, end: float | None, goes_on: bool) -> int:
        search = self._search
        mapper = self._mapper
        views = len(mapper.table.mapped)
        if end is None:
            return max(search.least_steps, search.steps_per_view * views)
        place = mapper.table.place
        done = place.steps if goes_on else 0
        if done > _ENOUGH_STEPS:
            seconds = place.seconds / done
        else:
            seconds = seconds_per_step(mapper.table, mapper.views, mapper.trainer, mapper.config)
        left = max(end - time.perf_counter(), 0.0)
        return int(np.clip(done + left / seconds, 1, search.most_steps_per_view * views))

    def _try_depths(self) -> tuple[int, float]:
        """Search some depths to measure the time; return their number and the seconds for each.

        In two groups, as the first one warms up.
        """
        group = group_size()
        ids = list(self._mapper.views)
        groups = [g for g in (ids[:group], ids[group : 2 * group]) if g]
        for some in groups:
            begin = time.perf_counter()
            self._mapper.search_depths(some)
            float(self._mapper.views[some[-1]].typical_depth)  # waits for a GPU
        seconds = (time.perf_counter() - begin) / len(groups[-1])
        return sum(map(len, groups)), seconds
