"""The disk map from images with known poses: find the scene, search depths, grow, train."""

import time
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mapping.known_poses import FEWEST_POINTS
from geogs.mapping.map_frame import WORLD, MapFrame
from geogs.mapping.mapper import Mapper
from geogs.mapping.posed_mapping import More, PosedMapping
from geogs.mapping.time_budget import TimeBudget
from geogs.reconstruction_output import ReconstructionOutput, ReconstructionTable
from geogs.stopwatch import StageProgress, Stopwatch, unwatched
from geogs.threads import on_one_torch_thread
from geogs.types import Trajectory
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.map import MapTable

OUTPUT_RATIO = 0.2
"""Fraction of a given time that is kept for the mesh and the report until a few views have shown
what these take."""


class Reconstruction(ReconstructionOutput):
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
        self._keyframes = store.new_set()
        self.stopwatch = Stopwatch()
        self.budget = TimeBudget(budget, OUTPUT_RATIO)
        self._poses: list[Float[Tensor, "4 4"]] = []
        self._all: Trajectory | None = None
        self._begin: float | None = None
        self._work_on(ReconstructionTable(MapTable.empty(device, self.config.seed), WORLD, []))

    def _work_on(self, table: ReconstructionTable) -> None:
        config, self.table = self.config, table
        keyframes = self._keyframes.table
        self.mapper = Mapper(keyframes, config.mapping, config.seed, table=table.map)
        self._stage = PosedMapping(self.mapper, config.search, self.budget, config.seed)

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
            self.table.images.append(index)
        self.budget.count_image()

    @on_one_torch_thread
    def finish(
        self,
        points: Float64[np.ndarray, "n 3"] | None = None,
        progress: StageProgress = unwatched,
        more: More | None = None,
    ) -> None:
        """Depths of all images, the map from them, training; ``points`` of the scene help.

        An exception raised by ``progress`` ends it early; the depths found by then make the map.
        Where there is a budget, ``more`` is called when some depths have been searched. It may set
        the ``output_cost`` of the budget, then ask for how many further images the time lasts, and
        add them.

        Raises:
            InputError: too few images, or no two of them show the same thing from two places.
        """
        if self.views < 2:
            raise InputError(f"There is only {self.views} image; depth needs at least two.")
        self._begin = time.perf_counter()
        if points is None or len(points) < FEWEST_POINTS:
            with self.stopwatch("first look"):
                points = self._stage.first_points(lambda f: progress("first look", f))
        self.table.frame = MapFrame.around(points, self._poses)
        self._place_keyframes()
        try:
            with self.stopwatch("depth"):
                self._stage.search(
                    self.table.frame.points(points), lambda f: progress("depth", f),
                    None if more is None else lambda count_of: self._add_more(more, count_of),
                    self._all is not None,
                )  # fmt: skip
        finally:
            if self.mapper.table.mapped:
                with self.stopwatch("growing"):
                    self.mapper.check_depths()
                    self.mapper.grow()
        progress("growing", 1.0)
        self._train(progress)

    def settle(self) -> ReconstructionTable:
        """The work so far, to be packed and to ``resume`` from; there is some once "growing" was
        reported."""
        self.mapper.settle()
        self.table.seconds = self.elapsed
        return self.table

    @on_one_torch_thread
    def resume(self, table: ReconstructionTable, progress: StageProgress = unwatched) -> None:
        """Instead of ``finish``, with the same images and settings: go on from the work of another.

        The time that it took counts.
        """
        self._begin = time.perf_counter() - table.seconds
        self.budget.count_spent(table.seconds)
        self._work_on(table)
        self._place_keyframes()
        self._train(progress, goes_on=True)

    def _place_keyframes(self) -> None:
        """Give the keyframes their poses in the map's frame."""
        for keyframe, T_cw in zip(self._keyframes, self._poses, strict=True):
            keyframe.T_cw = self.table.frame.pose(T_cw)

    def _add_more(self, more: More, count_of: Callable[[], int]) -> None:
        more(count_of)
        self._place_keyframes()

    def _train(self, progress: StageProgress, goes_on: bool = False) -> None:
        with self.stopwatch("training"):
            self._stage.train(lambda f: progress("training", f), goes_on)
