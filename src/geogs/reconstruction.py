"""The disk map from images with known poses: find the scene, search depths, grow, train."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.store import KeyframeStore
from geogs.mapping import known_poses as known
from geogs.mapping.depth_schedule import search_depths
from geogs.mapping.map_frame import MapFrame
from geogs.mapping.mapper import Mapper
from geogs.mapping.rendered import MapRenderer
from geogs.mapping.state import MapperState
from geogs.mapping.training.base import TrainingPlace
from geogs.on_demand import OnDemand
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory

Progress = Callable[[str, float], None]
"""Called with the name of a stage and its finished fraction in [0, 1]."""


def _silent(stage: str, fraction: float) -> None:
    """Progress that nobody watches."""


# Steps after which their time tells that of the next ones.
_TELLING_STEPS = 100


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
        store = KeyframeStore(SampleGrid(camera, device), None, self.config.resident_keyframes)
        self.mapper = Mapper(store, self.config.mapping, self.config.seed)
        self._keyframes = store.new_segment()
        self.stopwatch = Stopwatch()
        self._frame = MapFrame(np.zeros(3), 1.0)
        self._poses: list[Float[Tensor, "4 4"]] = []
        self._random = np.random.default_rng(self.config.seed)
        self._begin: float | None = None
        kept = 1.0 - self.config.search.output_share
        self._end = None if budget is None else time.perf_counter() + kept * budget

    @property
    def frames(self) -> int:
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

    @on_one_torch_thread
    def add(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        T_cw: Float64[np.ndarray, "4 4"],
        mask: Bool[np.ndarray, "h w"] | None = None,
        timestamp: float | None = None,
    ) -> None:
        """An RGB image, its world-to-camera pose, which pixels count, seconds (or its number)."""
        seconds = float(self.frames) if timestamp is None else timestamp
        with self.stopwatch("preparing"):
            pose = torch.from_numpy(np.asarray(T_cw, np.float64))
            keyframe = self._keyframes.add(self.frames, seconds, image, None, pose)
            self.mapper.observe(keyframe.id, mask)
            self._poses.append(pose)

    @on_one_torch_thread
    def finish(
        self, points: Float64[np.ndarray, "n 3"] | None = None, progress: Progress = _silent
    ) -> None:
        """Depths of all images, the map from them, training; ``points`` of the scene help.

        An exception raised by ``progress`` ends it early; the depths found by then make the map.

        Raises:
            InputError: too few images, or no two of them show the same thing from two places.
        """
        if self.frames < 2:
            raise InputError(f"There is only {self.frames} image; depth needs at least two.")
        self._begin = time.perf_counter()
        if points is None or len(points) < known.FEWEST_POINTS:
            with self.stopwatch("first look"):
                points = self._first_points(lambda f: progress("first look", f))
        self._frame = MapFrame.around(points, self._poses)
        self._place_keyframes()
        try:
            with self.stopwatch("depth"):
                self._search(self._frame.points(points), lambda f: progress("depth", f))
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
        return ReconstructionState(self.mapper.state(), frame.origin, frame.unit, self.elapsed)

    @on_one_torch_thread
    def resume(self, state: ReconstructionState, progress: Progress = _silent) -> None:
        """Instead of ``finish``, with the same images and settings: go on from the work of another.

        The time that it took counts.
        """
        self._begin = time.perf_counter() - state.seconds
        self._end = None if self._end is None else self._end - state.seconds
        self._frame = MapFrame(state.origin, state.unit)
        self._place_keyframes()
        self.mapper.load(state.mapper)
        self._train(progress, goes_on=True)

    def trajectory(self) -> Trajectory:
        """The given poses."""
        times = [keyframe.timestamp for keyframe in self._keyframes]
        T_wc = torch.linalg.inv(torch.stack(self._poses)).numpy()
        return Trajectory(np.array(times, np.float64), T_wc, np.ones(len(times), dtype=bool))

    keyframe_trajectory = trajectory
    """The same: every image counts."""

    def uncertainty(self) -> None:
        """Nothing: the poses were given."""
        return None

    def snapshot(self) -> MapSnapshot:
        """The disks as they are now."""
        return self._frame.world_snapshot(self.mapper.map.snapshot())

    @on_one_torch_thread
    def renders(self, disks: MapSnapshot | None = None) -> Sequence[RenderedKeyframe]:
        """Depth, normal and reliability of the map seen from every image, inside its mask.

        Of an earlier snapshot's disks where they are given. Rendered now; of many images most are
        read from a temporary file when they are asked for.
        """
        with self.stopwatch("rendering"):
            earlier = None if disks is None else self._frame.map_snapshot(disks)
            return self._in_world(self.mapper.renders(earlier))

    def renderer(self) -> MapRenderer:
        """What shows the map as it is now from anywhere."""
        return self.mapper.renderer(self._frame)

    def particulars(self) -> dict[str, object]:
        """Nothing that is not said of every result."""
        return {}

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """Depth and confidence of every image as searched, without the disks.

        Each is read when it is asked for, as it is at that time.
        """
        return self._in_world(self.mapper.depth_maps())

    def _in_world(self, renders: Sequence[RenderedKeyframe]) -> Sequence[RenderedKeyframe]:
        frame, poses = self._frame, self._poses
        return OnDemand(renders, lambda r: frame.world_render(r, poses[r.keyframe_id]))

    def _first_points(self, progress: Callable[[float], None]) -> np.ndarray:
        views, depth = list(self.mapper.views.values()), self.config.mapping.depth
        return known.first_points(views, self.camera, depth, self.config.search, progress)

    def _place_keyframes(self) -> None:
        """Give the keyframes their poses in the map's frame."""
        for keyframe, T_cw in zip(self._keyframes, self._poses, strict=True):
            keyframe.T_cw = self._frame.pose(T_cw)

    def _search(self, points: np.ndarray, progress: Callable[[float], None]) -> None:
        """Depths of the images; twice if time allows, the second time where the first found it.

        Of fewer images where time is short, evenly spread.
        """
        start, search, mapper = time.perf_counter(), self.config.search, self.mapper
        until = None if self._end is None else start + search.depth_share * (self._end - start)
        views, ids = list(mapper.views.values()), mapper.keyframe_ids
        known.expect_depths(views, points, self.camera, search.margin)
        share = 0.5 if search.repeat else 1.0
        search_depths(mapper, ids, lambda f: progress(share * f), until)
        now = time.perf_counter()
        affordable = self._end is None or 3 * (now - start) < self._end - now
        if search.repeat and affordable and len(mapper.mapped) == len(ids):
            mapper.check_depths()
            sure = known.dense_points(views, mapper.cameras.render, self._random)
            if len(sure) >= known.FEWEST_POINTS:
                known.expect_depths(views, sure, self.camera, search.margin)
            search_depths(mapper, ids, lambda f: progress(share + share * f))
        progress(1.0)

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
        most = search.most_steps_per_view * self.frames
        return int(np.clip(start.steps + left / seconds, 1, most))
