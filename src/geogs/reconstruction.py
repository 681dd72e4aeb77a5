"""Disk map from images with known poses: find the scene, search depths, grow, train."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

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
from geogs.mapping.rendered import MapRenderer
from geogs.mapping.time_budget import TimeBudget
from geogs.on_demand import OnDemand
from geogs.stopwatch import StageProgress, Stopwatch, unwatched
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, RenderedKeyframe, SeenRows, Trajectory, Uncertainty
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.map import MapTable


@dataclass(eq=False)
class ReconstructionTable:
    """State of a reconstruction, except its images."""

    map: MapTable
    frame: MapFrame
    """Frame in which the map is made."""
    images: list[int]
    """Indices of the images in their source, in the order in which they were added."""
    seconds: float = 0.0
    """Seconds since the images were read, when the table was settled."""


class Reconstruction:
    """Dense reconstruction without tracking: add posed images, finish, read the map.

    Poses and the map are in the unit of the given poses. With a ``budget`` in seconds, counted from
    the start, training takes the time that the depths leave of it.
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
        self.camera = camera.required_pinhole()
        store = KeyframeTable.on(SampleGrid(camera, device), None, self.config.resident_keyframes)
        self._keyframes = store.new_set()
        self.stopwatch = Stopwatch()
        # Fraction of the time budget reserved for mesh and report until their time has been
        # measured on a few views.
        self.budget = TimeBudget(budget, 0.2)
        self._poses: list[Float[Tensor, "4 4"]] = []
        """World-to-camera poses as given."""
        self._all: Trajectory | None = None
        """Poses of all images, including those that were not added."""
        self._begin: float | None = None
        """Time when all images had been added, by ``time.perf_counter``."""
        self._work_on(ReconstructionTable(MapTable.empty(device, self.config.seed), WORLD, []))

    def _work_on(self, table: ReconstructionTable) -> None:
        config = self.config
        self.table = table
        keyframes = self._keyframes.table
        self.mapper = Mapper(keyframes, config.mapping, config.seed, table=table.map)
        self._stage = PosedMapping(self.mapper, config.search, self.budget, config.seed)

    def know(self, poses: Trajectory) -> None:
        """Set the poses of all images of a set, of which some will be added."""
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
        """Add an RGB image with its world-to-camera pose, mask of valid pixels, time in seconds
        (default: its index), and index in its set (default: number of images added before)."""
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
        """Search depths of all images, make the map and train it; ``points`` of the scene help.

        An exception raised by ``progress`` ends it early; the map is made from the depths so far.
        With a budget, ``more`` is called when some depths have been searched. It may set the
        ``output_cost`` of the budget, then ask how many further images fit into the time, and add
        them.

        Raises:
            InputError: too few images, or no two of them show the same scene from two positions.
        """
        if self.views < 2:
            raise InputError(f"There is only {self.views} image; depth needs at least two.")
        self._begin = time.perf_counter()
        if points is None or len(points) < FEWEST_POINTS:
            with self.stopwatch("first look"):
                points = self._stage.first_points(lambda f: progress("first look", f))
        self.table.frame = MapFrame.around(points, self._poses)
        self._place_keyframes()
        points = self.table.frame.points(points)
        try:
            with self.stopwatch("depth"):
                self._stage.search(
                    points,
                    lambda f: progress("depth", f),
                    None if more is None else lambda count_of: self._add_more(more, count_of),
                    self._all is not None,
                )
        finally:
            if self.mapper.table.mapped:
                with self.stopwatch("growing"):
                    self.mapper.check_depths()
                    self.mapper.grow(torch.from_numpy(points))
        progress("growing", 1.0)
        self._train(progress)

    def settle(self) -> ReconstructionTable:
        """Return the state, to be packed and to ``resume`` from; valid once "growing" was
        reported."""
        self.mapper.settle()
        self.table.seconds = self.elapsed
        return self.table

    @on_one_torch_thread
    def resume(self, table: ReconstructionTable, progress: StageProgress = unwatched) -> None:
        """Continue from a saved state instead of ``finish``, with the same images and settings.

        The time spent before counts.
        """
        self._begin = time.perf_counter() - table.seconds
        self.budget.count_spent(table.seconds)
        self._work_on(table)
        self._place_keyframes()
        self._train(progress, goes_on=True)

    def _place_keyframes(self) -> None:
        """Set the poses of the keyframes in the map's frame."""
        for keyframe, T_cw in zip(self._keyframes, self._poses, strict=True):
            keyframe.T_cw = self.table.frame.pose(T_cw)

    def _add_more(self, more: More, count_of: Callable[[], int]) -> None:
        more(count_of)
        self._place_keyframes()

    def _train(self, progress: StageProgress, goes_on: bool = False) -> None:
        with self.stopwatch("training"):
            self._stage.train(lambda f: progress("training", f), goes_on)

    # --- results, available at any time -------------------------------------------------------

    @property
    def frames(self) -> int:
        """Number of images with known poses, added or not."""
        return len(self._poses) if self._all is None else len(self._all.timestamps)

    @property
    def views(self) -> int:
        """Number of images added so far."""
        return len(self._poses)

    @property
    def with_depth(self) -> int:
        """Number of images whose depth has been searched, from which the map is made."""
        return len(self.mapper.table.mapped)

    @property
    def elapsed(self) -> float:
        """Seconds since all images had been added (``finish`` was called)."""
        return 0.0 if self._begin is None else time.perf_counter() - self._begin

    def trajectory(self) -> Trajectory:
        """Return the given poses of all images."""
        return self.keyframe_trajectory() if self._all is None else self._all

    def keyframe_trajectory(self) -> Trajectory:
        """Return the given poses of the mapped images, or of all that were added while there is no
        map, in the order of their set."""
        order = self._in_order(self.mapper.table.mapped or range(self.views))
        times = [self._keyframes[i].timestamp for i in order]
        T_wc = torch.linalg.inv(torch.stack([self._poses[i] for i in order])).numpy()
        return Trajectory(np.array(times, np.float64), T_wc, np.ones(len(times), dtype=bool))

    def uncertainty(self) -> Uncertainty | None:
        """Return None: the poses were given."""
        return None

    def snapshot(self) -> MapSnapshot:
        """Return the present disks."""
        return self.table.frame.world_snapshot(self.mapper.table.disks.snapshot())

    @on_one_torch_thread
    def renders(
        self, disks: MapSnapshot | None = None, of: Sequence[int] | None = None
    ) -> Sequence[RenderedKeyframe]:
        """Render depth, normal and confidence of the map from every image, inside its mask.

        ``of``: ids of the keyframes, instead of all; ``disks``: an earlier snapshot to render.
        Rendered now; if there are many images, most are read from a temporary file on access.
        """
        with self.stopwatch("rendering"):
            earlier = None if disks is None else self.table.frame.map_snapshot(disks)
            chosen = self._in_order(self.mapper.table.mapped if of is None else of)
            return self._in_world(self.mapper.renders(earlier, chosen))

    def renderer(self) -> MapRenderer:
        """Return a renderer of the present map for any view."""
        return self.mapper.renderer(self.table.frame)

    def rows(self) -> dict[int, SeenRows]:
        """Return no rows: given poses are those of whole images."""
        return {}

    def statistics(self) -> dict[str, object]:
        """Return no statistics beyond those of every result."""
        return {}

    def depth_maps(self, of: Sequence[int] | None = None) -> Sequence[RenderedKeyframe]:
        """Return the searched depth and confidence of every image, or of some keyframes, without
        disks. Each is read on access.
        """
        chosen = self._in_order(self.mapper.table.mapped if of is None else of)
        return self._in_world(self.mapper.depth_maps(chosen))

    def _in_world(self, renders: Sequence[RenderedKeyframe]) -> Sequence[RenderedKeyframe]:
        unit = self.table.frame.unit
        poses = self._poses
        return OnDemand(
            renders, lambda r: replace(r, depth=r.depth * unit, T_cw=poses[r.keyframe_id])
        )

    def _in_order(self, keyframe_ids: Iterable[int]) -> list[int]:
        """Sort keyframes by the order of their images in the set."""
        return sorted(keyframe_ids, key=lambda i: self.table.images[i])
