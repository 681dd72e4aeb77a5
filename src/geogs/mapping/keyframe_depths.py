"""The dense depths of the map's keyframes: searched, fused with a sensor, and checked."""

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import DepthSensorConfig
from geogs.depth.depth_engine import DepthEngine, DepthTask, Progress, silent
from geogs.depth.depth_view import DenseDepth
from geogs.depth.revision.segment_planes import planar_depth
from geogs.depth.sweep_neighbors import select_sweep_neighbours
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.mapping.partners import CANDIDATES
from geogs.mapping.view_arrays import get_depth, put_depth
from geogs.on_demand import OnDemand
from geogs.priors.depth_sensor import sensor_depth
from geogs.threads import ordered_map, worker_count
from geogs.world.arrays import ArrayTable
from geogs.world.keyframes import Keyframe

CHECKING_VIEWS = 8
"""Keyframes whose depth checks a new keyframe's depth and whose free space carves around it."""
SEARCHED_TOGETHER = 32
"""Keyframes whose images and depths are in memory at once when all are searched again."""
TOLERANCE = 0.02
"""Relative error below which a depth is right: confidences are the chance of that."""
MIN_DEVIATION = 0.02
"""Least relative deviation of a searched depth where there is a measured one."""
MAX_DIFFERENCE = 3.0
"""Standard deviations of the difference beyond which the searched depth is an outlier."""
MAX_CONFIDENCE = 0.98
"""Largest confidence of a measured depth."""


class KeyframeDepths:
    """Searches the depths of keyframes, and lets them check each other."""

    def __init__(
        self,
        engine: DepthEngine,
        views: KeyframeViews,
        sensor: DepthSensorConfig | None,
        bare_planes: bool,
    ) -> None:
        """With ``bare_planes``, uncertain depths of bare segments are put on planes."""
        self.engine = engine
        self.views = views
        self.sensor = sensor or DepthSensorConfig()
        self.bare_planes = bare_planes

    def estimate(self, views: Sequence[MapView], progress: Progress = silent) -> None:
        """Search the depths of some views, not too many at once.

        Normals of the depth network are left out: as N_f of the map's loss they make facets
        smoother, but depths less accurate (docs/depth-network.md).
        """

        def on(done: float) -> None:
            progress((start + done * len(batch)) / len(views))

        for start in range(0, len(views), SEARCHED_TOGETHER):
            batch = views[start : start + SEARCHED_TOGETHER]
            depths = self.engine.estimate([self._task(view) for view in batch], on)
            for view, depth in zip(batch, self._planar(batch, depths), strict=True):
                view.set_depth(replace(self._with_sensor(view, depth), normal=None))

    def check(self, views: Sequence[MapView]) -> None:
        """Revise the depths of views by those of their neighbours, all as they were estimated."""
        device = self.views.arrays.device
        arrays = ArrayTable()
        checked = []
        for start in range(0, len(views), SEARCHED_TOGETHER):
            batch = views[start : start + SEARCHED_TOGETHER]
            others = [[o.posed for o in self.near(view)] for view in batch]
            depths = self.engine.check([view.posed for view in batch], others)
            depths = self._planar(batch, depths)
            if len(views) == len(batch):
                for view, depth in zip(views, depths, strict=True):
                    view.set_depth(depth)
                return
            pairs = zip(batch, depths, strict=True)
            checked += [(v.id, put_depth(arrays, v.id, depth, 1.0)) for v, depth in pairs]
        for id, stored in checked:
            self.views[id].set_depth(get_depth(arrays, id, stored, 1.0, device))

    def near(self, view: MapView) -> list[MapView]:
        """The keyframes with a depth that see a view's surface best from elsewhere."""
        around = self.views.near(view, self.views, CANDIDATES)
        known = [v for v in around if v.has_depth and v.id != view.id]
        chosen = self._placed(view, known, view.typical_depth)
        return chosen[:CHECKING_VIEWS]

    def keep(self, points: Float[Tensor, "n 3"], views: Sequence[MapView]) -> Bool[Tensor, "n"]:
        """Whether world points lie outside the free space of some views."""
        known = [v for v in views if v.has_depth]
        # Read one after the other where they are not in memory.
        return self.engine.keep(points, OnDemand(known, attrgetter("posed")))

    def _task(self, view: MapView) -> DepthTask:
        """The search of a view's depth: its neighbours and its range."""
        search = view.row.search
        depth = tracked_depth(view.keyframe) if search is None else search.typical
        around = self.views.near(view, self.views, CANDIDATES)
        neighbours = [v.depth_view for v in self._placed(view, around, depth)]
        limits = None if search is None else (search.near, search.far)
        return DepthTask(view.depth_view, neighbours, limits)

    def _placed(self, view: MapView, others: list[MapView], depth: float) -> list[MapView]:
        """The other views that suit a search around a depth, best first."""
        poses = [v.view_pose for v in others]
        camera = self.views.arrays.cameras.render
        chosen = select_sweep_neighbours(view.view_pose, poses, depth, camera)
        return [others[i] for i in chosen]

    def _planar(self, views: Sequence[MapView], depths: list[DenseDepth]) -> list[DenseDepth]:
        """The depths of views; with ``bare_planes``, those of bare segments are on planes."""
        if not self.bare_planes:
            return depths
        camera = self.views.arrays.cameras.render

        def one(pair: tuple[MapView, DenseDepth]) -> DenseDepth:
            view, depth = pair
            return planar_depth(view.bare_segments, depth, camera, view.id)

        pairs = zip(views, depths, strict=True)
        return list(ordered_map(one, pairs, worker_count()))

    def _with_sensor(self, view: MapView, searched: DenseDepth) -> DenseDepth:
        """The searched depth, fused with a sensor's if there is one."""
        keyframe = view.keyframe
        render = self.views.arrays.cameras.render
        if keyframe.measured is None or (metres := keyframe.sensor_depth) is None:
            return searched
        found = sensor_depth(metres, self.sensor).resized(render.width, render.height)
        inverse_depth, information = found.tensors(self.views.arrays.device)
        scale = keyframe.scale
        return fused_with_sensor(searched, inverse_depth / scale, information * scale**2)


def tracked_depth(keyframe: Keyframe) -> float:
    """Median depth of the cells with a fairly certain depth of the tracker, else of all."""
    z = 1 / keyframe.inverse_depth.clamp(min=1e-3)
    known = z / keyframe.confident_information.clamp(min=1e-12).sqrt() < 0.2
    return float(z[known].median() if int(known.sum()) > 8 else z.median())


def fused_with_sensor(
    searched: DenseDepth, inverse_depth: Float[Tensor, "h w"], information: Float[Tensor, "h w"]
) -> DenseDepth:
    """Mean of the searched and the measured depth, weighted by their inverse variances.

    Where they do not agree, the measured depth; where nothing was measured, the searched one. The
    measurement is an inverse depth, per map unit, and its information 1 / sigma^2, 0 for none.
    """
    known = information > 0
    measured = torch.where(known, 1 / inverse_depth.clamp(min=1e-12), searched.depth)
    own = torch.where(known, measured / information.clamp(min=1e-12).sqrt(), 1.0)
    chance = searched.confidence.clamp(1e-3, 1 - 1e-3)
    theirs = (TOLERANCE / (math.sqrt(2) * torch.erfinv(chance))).clamp(min=MIN_DEVIATION)
    step = searched.depth / measured - 1
    agree = step.abs() < MAX_DIFFERENCE * torch.hypot(own, theirs)
    fraction = torch.where(known & agree, own.square() / (own.square() + theirs.square()), 0.0)
    depth = torch.where(known, measured * (1 + fraction * step), searched.depth)
    deviation = own * (1 - fraction).sqrt()
    right = torch.erf(TOLERANCE / (math.sqrt(2) * deviation)).clamp(max=MAX_CONFIDENCE)
    confidence = torch.where(known, right, searched.confidence)
    median = depth.median().cpu()
    return replace(searched, depth=depth, confidence=confidence, median=median, written=None)
