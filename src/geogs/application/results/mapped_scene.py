"""What a result is written of: a run or a reconstruction, whichever made the map."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from geogs.config import Config, ReconstructConfig
from geogs.mapping.rendered import MapRenderer
from geogs.stopwatch import Stopwatch
from geogs.types import MapSnapshot, RenderedKeyframe, SeenRows, Trajectory, Uncertainty


@runtime_checkable
class MappedScene(Protocol):
    """What has a trajectory, disks and depth maps to write."""

    stopwatch: Stopwatch

    @property
    def config(self) -> Config | ReconstructConfig:
        """The settings by which it was made."""
        ...

    @property
    def frames(self) -> int:
        """Images so far."""
        ...

    def trajectory(self) -> Trajectory:
        """Poses of all frames."""
        ...

    def keyframe_trajectory(self) -> Trajectory:
        """Poses of the keyframes alone."""
        ...

    def uncertainty(self) -> Uncertainty | None:
        """How well frames are known; none where the poses were given."""
        ...

    def snapshot(self) -> MapSnapshot:
        """The disks."""
        ...

    def renders(self) -> Sequence[RenderedKeyframe]:
        """The map seen from every keyframe."""
        ...

    def renderer(self) -> MapRenderer:
        """What shows the map from anywhere."""
        ...

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """The keyframes' depths as searched."""
        ...

    def rows(self) -> Mapping[int, SeenRows]:
        """Where and when rectified rows of keyframes were seen, by id of the keyframe."""
        ...

    def statistics(self) -> Mapping[str, object]:
        """What else the summary says, ready for JSON."""
        ...
