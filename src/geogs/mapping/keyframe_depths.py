"""The dense depths of a mapper's keyframes: searched, measured, and checked by those around."""

from geogs.config import DepthSensorConfig
from geogs.depth.base import DepthEngine, Progress, silent
from geogs.depth.sensor import joined
from geogs.depth.sweep_neighbors import select_sweep_neighbours
from geogs.mapping.near_views import NearViews
from geogs.mapping.stored_maps import StoredDepth
from geogs.mapping.view import MapView
from geogs.mapping.view_pool import ViewPool

CANDIDATES = 128
"""Nearest keyframes among which those are looked for that match or check one."""
CHECKING_VIEWS = 8
"""Keyframes whose depth checks a new keyframe's depth and whose free space carves around it."""
SEARCHED_TOGETHER = 32
"""Keyframes whose images and depths are in memory at once where all are searched anew."""


class KeyframeDepths:
    """Searches the depths of some of all ``views``, and lets them check each other."""

    def __init__(
        self,
        engine: DepthEngine,
        views: dict[int, MapView],
        pool: ViewPool,
        sensor: DepthSensorConfig | None = None,
    ) -> None:
        self.sensor = sensor or DepthSensorConfig()
        self.engine = engine
        self.views = views
        self._near = NearViews(views)
        self.pool = pool

    def estimate(self, views: list[MapView], progress: Progress = silent) -> None:
        """Search the depths of some views, not too many at once."""

        def on(done: float) -> None:
            progress((start + done * len(batch)) / len(views))

        for start in range(0, len(views), SEARCHED_TOGETHER):
            batch = views[start : start + SEARCHED_TOGETHER]
            self._search(batch, on)

    def _search(self, views: list[MapView], progress: Progress) -> None:
        references, neighbours = [v.depth_view for v in views], []
        limits = [None if v.search is None else (v.search.near, v.search.far) for v in views]
        for view in views:
            depth = view.tracked_depth if view.search is None else view.search.typical
            candidates = self._near.around(view, self.views, CANDIDATES)
            places = [v.place for v in candidates]
            chosen = select_sweep_neighbours(view.place, places, depth)
            neighbours.append([candidates[i].depth_view for i in chosen])
        depths = self.engine.estimate(references, neighbours, progress, limits)
        for view, dense in zip(views, depths, strict=True):
            sensed = view.sensed(self.sensor)
            self.pool.set_depth(view.id, dense if sensed is None else joined(dense, *sensed))

    def check(self, views: list[MapView]) -> None:
        """Let the neighbours' depths, as they were estimated, revise those of the views."""
        checked: list[StoredDepth] = []
        for start in range(0, len(views), SEARCHED_TOGETHER):
            batch = views[start : start + SEARCHED_TOGETHER]
            others = [[o.posed for o in self.near(view)] for view in batch]
            depths = self.engine.check([view.posed for view in batch], others)
            if len(views) == len(batch):
                for view, depth in zip(views, depths, strict=True):
                    self.pool.set_depth(view.id, depth)
                return
            checked += [StoredDepth.of(depth, 1.0, self.pool.archive) for depth in depths]
        for view, stored in zip(views, checked, strict=True):
            self.pool.set_depth(view.id, stored.load(1.0, self.pool.device))

    def near(self, view: MapView) -> list[MapView]:
        """The keyframes with a depth that see a view's surface best from elsewhere."""
        around = self._near.around(view, self.views, CANDIDATES)
        known = [v for v in around if v.has_depth and v.id != view.id]
        places = [v.place for v in known]
        depth = view.typical_depth
        chosen = select_sweep_neighbours(view.place, places, depth)
        return [known[i] for i in chosen[:CHECKING_VIEWS]]
