"""What can be asked of a reconstruction from known poses at any time."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.mapping.map_frame import MapFrame
from geogs.mapping.mapper import Mapper
from geogs.mapping.rendered import MapRenderer
from geogs.on_demand import OnDemand
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, RenderedKeyframe, SeenRows, Trajectory, Uncertainty
from geogs.world.keyframes import KeyframeSet
from geogs.world.map import MapTable


@dataclass(eq=False)
class ReconstructionTable:
    """All that the work of a reconstruction has come to, beside its images."""

    map: MapTable
    frame: MapFrame
    """Frame in which the map is made."""
    images: list[int]
    """Places in their source of the images, as they were added."""
    seconds: float = 0.0
    """Spent since the images had been read, when the table was settled."""


class ReconstructionOutput:
    """Reads the table and the mapper; changes nothing of them."""

    table: ReconstructionTable
    mapper: Mapper
    stopwatch: Stopwatch
    _keyframes: KeyframeSet
    _poses: list[Float[Tensor, "4 4"]]
    """World-to-camera poses as given."""
    _all: Trajectory | None
    """Poses of images that were not added, too."""
    _begin: float | None
    """When all images were there, by ``time.perf_counter``."""

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
        return len(self.mapper.table.mapped)

    @property
    def elapsed(self) -> float:
        """Seconds since all images were there: since ``finish`` was called."""
        return 0.0 if self._begin is None else time.perf_counter() - self._begin

    def trajectory(self) -> Trajectory:
        """The given poses of all images."""
        return self.keyframe_trajectory() if self._all is None else self._all

    def keyframe_trajectory(self) -> Trajectory:
        """The given poses of the images that make the map, or of all that were added while there is
        none, in the order of their set."""
        order = self._in_order(self.mapper.table.mapped or range(self.views))
        times = [self._keyframes[i].timestamp for i in order]
        T_wc = torch.linalg.inv(torch.stack([self._poses[i] for i in order])).numpy()
        return Trajectory(np.array(times, np.float64), T_wc, np.ones(len(times), dtype=bool))

    def uncertainty(self) -> Uncertainty | None:
        """Nothing: the poses were given."""
        return None

    def snapshot(self) -> MapSnapshot:
        """The disks as they are now."""
        return self.table.frame.world_snapshot(self.mapper.table.disks.snapshot())

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
            earlier = None if disks is None else self.table.frame.map_snapshot(disks)
            chosen = self._in_order(self.mapper.table.mapped if of is None else of)
            return self._in_world(self.mapper.renders(earlier, chosen))

    def renderer(self) -> MapRenderer:
        """What shows the map as it is now from anywhere."""
        return self.mapper.renderer(self.table.frame)

    def rows(self) -> dict[int, SeenRows]:
        """None: poses that were given are those of whole images."""
        return {}

    def statistics(self) -> dict[str, object]:
        """Nothing that is not said of every result."""
        return {}

    def depth_maps(self, of: Sequence[int] | None = None) -> Sequence[RenderedKeyframe]:
        """Depth and confidence of every image, or of some keyframes, as searched, without disks.

        Each is read when it is asked for, as it is at that time.
        """
        chosen = self._in_order(self.mapper.table.mapped if of is None else of)
        return self._in_world(self.mapper.depth_maps(chosen))

    def _in_world(self, renders: Sequence[RenderedKeyframe]) -> Sequence[RenderedKeyframe]:
        unit, poses = self.table.frame.unit, self._poses
        return OnDemand(
            renders, lambda r: replace(r, depth=r.depth * unit, T_cw=poses[r.keyframe_id])
        )

    def _in_order(self, keyframe_ids: Iterable[int]) -> list[int]:
        """Keyframes in the order of their images in the set."""
        return sorted(keyframe_ids, key=lambda i: self.table.images[i])
