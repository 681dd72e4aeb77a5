"""The disk map from images with known poses: find the scene, search depths, grow, train."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mapping import known_poses as known
from geogs.mapping.depth_schedule import group_size, search_depths, spread_order
from geogs.mapping.first_look import SmallImage, first_points
from geogs.mapping.map_frame import MapFrame
from geogs.mapping.mapper import Mapper
from geogs.mapping.near_views import NearViews
from geogs.mapping.rendered import MapRenderer
from geogs.mapping.state import MapperState
from geogs.mapping.time_shares import ViewCost, affordable_views, helpers
from geogs.mapping.training.base import TrainingPlace
from geogs.on_demand import OnDemand
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, RenderedKeyframe, SeenRows, Trajectory, Uncertainty
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable

Progress = Callable[[str, float], None]
"""Called with the name of a stage and its finished fraction in [0, 1]."""
More = Callable[[Callable[[], int]], None]
"""Adds at most as many further images as what it is given says, once it is asked."""


@dataclass(frozen=True)
class OutputCost:
    """What the mesh and the files are going to take, seconds."""

    once: float
    """However many images make the map."""
    a_view: float
    """For each of them."""

    def of(self, views: int) -> float:
        """Of so many images."""
        return self.once + views * self.a_view


def _silent(stage: str, fraction: float) -> None:
    """Progress that nobody watches."""


# Steps after which their time tells that of the next ones.
_TELLING_STEPS = 100


OUTPUT_RATIO = 0.2
"""Fraction of a given time that is kept for the mesh and the report until a few views have shown
what these take."""
RANGE_MARGIN = 1.3
"""Factor by which searched depths go beyond those that are known, which are not all."""


@dataclass(frozen=True, eq=False)
class ReconstructionState:
    """The work of a reconstruction after its depths, to go on from later."""

    mapper: MapperState
    origin: Float64[np.ndarray, "3"]
    """World coordinates of the map's origin."""
    unit: float
    """Length of a map unit in the world."""
    seconds: float
    """Spent since the images had been read."""
    images: list[int]
    """Places in their source of the images, as they were added."""


class Reconstruction:
    """Dense reconstruction without tracking: add posed images, finish, read the map.

    Poses and the map are in the unit of the given poses. With a ``budget`` in seconds, counted from
    now on, training takes the time that the depths leave of it.
    """

    def __init__(
        self,
        camera: Camera,
        config: ReconstructConfig | None = None,
        device: str = "cpu",
        budget: float | None = None,
    ):
        self.config = config or ReconstructConfig()
        if self.config.mapping.depth.engine == "tracker":
            raise InputError("mapping.depth.engine tracker needs a tracker: geogs run has one.")
        self.camera = camera
        store = KeyframeTable.on(SampleGrid(camera, device), None, self.config.resident_keyframes)
        self.mapper = Mapper(store, self.config.mapping, self.config.seed)
        self._keyframes = store.new_set()
        self.stopwatch = Stopwatch()
        self._frame = MapFrame(np.zeros(3), 1.0)
        self._poses: list[Float[Tensor, "4 4"]] = []
        self._images: list[int] = []
        self._added: list[float] = []
        self._all: Trajectory | None = None
        self._wanted = 0
        self._random = np.random.default_rng(self.config.seed)
        self._begin: float | None = None
        self._deadline = None if budget is None else time.perf_counter() + budget
        self.output_cost = OutputCost(OUTPUT_RATIO * (budget or 0.0), 0.0)
        """What comes after the training: a part of the budget until somebody knows better."""

    @property
    def _end(self) -> float | None:
        """When training must have ended for what comes after it."""
        if self._deadline is None:
            return None
        return self._deadline - self.output_cost.of(self._wanted or self.views)

    @property
    def budget_left(self) -> float:
        """Seconds of the budget, for all that is still to be done; infinite without one."""
        return np.inf if self._deadline is None else self._deadline - time.perf_counter()

    @property
    def seconds_left(self) -> float:
        """Of the budget, until training must have ended; infinite without a budget."""
        return np.inf if self._end is None else self._end - time.perf_counter()

    @property
    def frames(self) -> int:
        """Images whose poses are known, whether they were added or not."""
        return len(self._poses) if self._all is None else len(self._all.timestamps)

    @property
    def views(self) -> int:
        """Images added so far."""
        return len(self._poses)

    @property
    def with_depth(self) -> int:
        """Images whose depth has been searched: those that make the map."""
        return len(self.mapper.mapped)

    @property
    def elapsed(self) -> float:
        """Seconds since all images were there: since ``finish`` was called."""
        return 0.0 if self._begin is None else time.perf_counter() - self._begin

    def know(self, poses: Trajectory) -> None:
        """Poses of all images of a set, some of which are going to be added."""
        self._all = poses

    @on_one_torch_thread
    def add(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        T_cw: Float64[np.ndarray, "4 4"],
        mask: Bool[np.ndarray, "h w"] | None = None,
        timestamp: float | None = None,
        index: int | None = None,
    ) -> None:
        """An RGB image, its world-to-camera pose, which pixels count, seconds (or its number), and
        its place in the set that it is from (or how many were added before it)."""
        index = self.views if index is None else index
        seconds = float(index) if timestamp is None else timestamp
        with self.stopwatch("preparing"):
            pose = torch.from_numpy(np.asarray(T_cw, np.float64))
            keyframe = self._keyframes.add(index, seconds, image, None, pose)
            self.mapper.observe(keyframe.id, mask)
            self._poses.append(pose)
            self._images.append(index)
        self._added.append(time.perf_counter())

    @on_one_torch_thread
    def finish(
        self,
        points: Float64[np.ndarray, "n 3"] | None = None,
        progress: Progress = _silent,
        more: More | None = None,
    ) -> None:
        """Depths of all images, the map from them, training; ``points`` of the scene help.

        An exception raised by ``progress`` ends it early; the depths found by then make the map.
        Where there is a budget, ``more`` is called when some depths have been searched. It may set
        ``output_cost``, then ask for how many further images the time lasts, and add them.

        Raises:
            InputError: too few images, or no two of them show the same thing from two places.
        """
        if self.views < 2:
            raise InputError(f"There is only {self.views} image; depth needs at least two.")
        self._begin = time.perf_counter()
        if points is None or len(points) < known.FEWEST_POINTS:
            with self.stopwatch("first look"):
                points = self._first_points(lambda f: progress("first look", f))
        self._frame = MapFrame.around(points, self._poses)
        self._place_keyframes()
        try:
            with self.stopwatch("depth"):
                self._search(self._frame.points(points), progress, more)
        finally:
            if self.mapper.mapped:
                with self.stopwatch("growing"):
                    self.mapper.check_depths()
                    self.mapper.grow()
        progress("growing", 1.0)
        self._train(progress)

    def state(self) -> ReconstructionState:
        """The work so far, to ``resume`` from; there is some once "growing" was reported."""
        frame = self._frame
        return ReconstructionState(
            self.mapper.state(), frame.origin, frame.unit, self.elapsed, self._images
        )

    @on_one_torch_thread
    def resume(self, state: ReconstructionState, progress: Progress = _silent) -> None:
        """Instead of ``finish``, with the same images and settings: go on from the work of another.

        The time that it took counts.
        """
        self._begin = time.perf_counter() - state.seconds
        if self._deadline is not None:
            self._deadline -= state.seconds
        self._frame = MapFrame(state.origin, state.unit)
        self._place_keyframes()
        self.mapper.load(state.mapper)
        self._train(progress, goes_on=True)

    def trajectory(self) -> Trajectory:
        """The given poses of all images."""
        return self.keyframe_trajectory() if self._all is None else self._all

    def keyframe_trajectory(self) -> Trajectory:
        """The given poses of the images that make the map, or of all that were added while there is
        none, in the order of their set."""
        order = self._in_order(self.mapper.mapped or range(self.views))
        times = [self._keyframes[i].timestamp for i in order]
        T_wc = torch.linalg.inv(torch.stack([self._poses[i] for i in order])).numpy()
        return Trajectory(np.array(times, np.float64), T_wc, np.ones(len(times), dtype=bool))

    def uncertainty(self) -> Uncertainty | None:
        """Nothing: the poses were given."""
        return None

    def snapshot(self) -> MapSnapshot:
        """The disks as they are now."""
        return self._frame.world_snapshot(self.mapper.map.snapshot())

    @on_one_torch_thread
    def renders(
        self, disks: MapSnapshot | None = None, of: Sequence[int] | None = None
    ) -> Sequence[RenderedKeyframe]:
        """Depth, normal and reliability of the map seen from every image, inside its mask.

        From some keyframes alone, where these are given by id; of an earlier snapshot's disks
        where they are given. Rendered now; of many images most are read from a temporary file when
        they are asked for.
        """
        with self.stopwatch("rendering"):
            earlier = None if disks is None else self._frame.map_snapshot(disks)
            chosen = self._in_order(self.mapper.mapped if of is None else of)
            return self._in_world(self.mapper.renders(earlier, chosen))

    def renderer(self) -> MapRenderer:
        """What shows the map as it is now from anywhere."""
        return self.mapper.renderer(self._frame)

    def rows(self) -> dict[int, SeenRows]:
        """None: poses that were given are those of whole images."""
        return {}

    def particulars(self) -> dict[str, object]:
        """Nothing that is not said of every result."""
        return {}

    def depth_maps(self, of: Sequence[int] | None = None) -> Sequence[RenderedKeyframe]:
        """Depth and confidence of every image, or of some keyframes, as searched, without disks.

        Each is read when it is asked for, as it is at that time.
        """
        chosen = self._in_order(self.mapper.mapped if of is None else of)
        return self._in_world(self.mapper.depth_maps(chosen))

    def image_of(self, keyframe_id: int) -> int:
        """Place in its set of the image of a keyframe."""
        return self._images[keyframe_id]

    def neighbouring(self, count: int) -> list[int]:
        """Ids of at most so many mapped keyframes that were taken near each other."""
        mapped, near = self.mapper.mapped, NearViews(self.mapper.views)
        first = self.mapper.views[next(iter(mapped))]
        return [view.id for view in near.around(first, mapped, count)]

    def _in_world(self, renders: Sequence[RenderedKeyframe]) -> Sequence[RenderedKeyframe]:
        frame, poses = self._frame, self._poses
        return OnDemand(renders, lambda r: frame.world_render(r, poses[r.keyframe_id]))

    def _in_order(self, keyframe_ids: Iterable[int]) -> list[int]:
        """Keyframes in the order of their images in the set."""
        return sorted(keyframe_ids, key=lambda i: self._images[i])

    def _first_points(self, progress: Callable[[float], None]) -> np.ndarray:
        views = list(self.mapper.views.values())

        def image_at(index: int) -> SmallImage:
            mask = views[index].mask
            image = self._keyframes[views[index].id].image
            return image, None if mask is None else mask.cpu().numpy()

        places = [view.place for view in views]
        return first_points(places, image_at, self.camera, progress)

    def _place_keyframes(self) -> None:
        """Give the keyframes their poses in the map's frame."""
        for keyframe, T_cw in zip(self._keyframes, self._poses, strict=True):
            keyframe.T_cw = self._frame.pose(T_cw)

    def _search(self, points: np.ndarray, progress: Progress, more: More | None) -> None:
        """Depths of the images; twice if time allows, the second time where the first found it.

        Of fewer images where time is short, evenly spread.
        """
        search, mapper = self.config.search, self.mapper
        known.expect_depths(mapper.views.values(), points, self.camera, RANGE_MARGIN)
        share = 0.5 if search.repeat else 1.0

        def report(fraction: float) -> None:
            progress("depth", fraction)

        if more is not None and self._deadline is not None:
            searched, seconds = self._try_depths()
            more(lambda: self._further_views(searched, seconds))
            self._place_keyframes()
            new = [v for v in mapper.views.values() if v.search is None]
            known.expect_depths(new, points, self.camera, RANGE_MARGIN)
        ids = [*mapper.views] if self._all is not None else spread_order(mapper.keyframe_ids)
        wanted = self._wanted or len(ids)
        start, end, before = time.perf_counter(), self._end, len(mapper.mapped)
        until = None if end is None else start + search.depth_ratio * (end - start)
        if until is not None:  # each that is searched beyond those is paid for in the mesh, too
            until -= self.output_cost.a_view * group_size()
        order = [i for i in ids if not mapper.views[i].has_depth]
        search_depths(mapper, order, lambda f: report(share * f), until)
        now = time.perf_counter()
        mapped = len(mapper.mapped)
        again = (now - start) * mapped / max(mapped - before, 1)
        affordable = end is None or 3 * again < end - now
        if search.repeat and affordable and mapped >= wanted:
            views = [mapper.views[i] for i in mapper.mapped]
            mapper.check_depths()
            sure = known.dense_points(views, mapper.cameras.render, self._random)
            if len(sure) >= known.FEWEST_POINTS:
                known.expect_depths(views, sure, self.camera, RANGE_MARGIN)
            search_depths(mapper, mapper.mapped, lambda f: report(share + share * f))
        self._wanted = self.with_depth
        report(1.0)

    def _try_depths(self) -> tuple[int, float]:
        """Search some depths to see how long that takes: how many, and seconds for each.

        In two groups, as the first one makes ready what is needed but once.
        """
        group, ids = group_size(), self.mapper.keyframe_ids
        groups = [g for g in (ids[:group], ids[group : 2 * group]) if g]
        for some in groups:
            begin = time.perf_counter()
            self.mapper.search_depths(some)
            float(self.mapper.views[some[-1]].typical_depth)  # waits for a GPU
        seconds = (time.perf_counter() - begin) / len(groups[-1])
        return sum(map(len, groups)), seconds

    def _further_views(self, searched: int, seconds: float) -> int:
        """How many more images to read, of which some have been searched already.

        As many as the time lasts for; where these are few, so that none may stand next to another,
        some that only help to find the depths of these.
        """
        search, times, output = self.config.search, self._added, self.output_cost
        assert self._deadline is not None
        cost = ViewCost((times[-1] - times[0]) / max(len(times) - 1, 1), seconds, output.a_view)
        left = self._deadline - time.perf_counter() - output.once
        self._wanted = max(affordable_views(left, cost, search, searched, self.views), searched)
        return max(self._wanted + helpers(self._wanted, left, cost) - self.views, 0)

    def _train(self, progress: Progress, goes_on: bool = False) -> None:
        with self.stopwatch("training"):
            steps = self._steps(self.mapper.trained if goes_on else TrainingPlace())
            self.mapper.train(steps, lambda f: progress("training", f), self._end, goes_on)

    def _steps(self, start: TrainingPlace) -> int:
        """As many training steps as the time allows, or the usual number where none is given."""
        search = self.config.search
        if self._end is None:
            return max(search.least_steps, search.steps_per_view * self.with_depth)
        known = start.steps > _TELLING_STEPS
        seconds = start.seconds / start.steps if known else self.mapper.seconds_per_step()
        left = max(self._end - time.perf_counter(), 0.0)
        most = search.most_steps_per_view * self.with_depth
        return int(np.clip(start.steps + left / seconds, 1, most))
