"""Mapping after the stream has ended, from all keyframes at their final poses."""

from collections.abc import Sequence

from geogs.executors.in_order import InOrder, Progress
from geogs.mapping.map_all import map_all


class Deferred(InOrder):
    """In order, except the map: made from all keyframes at once, which takes less time."""

    maps_at_end = True

    def map(
        self, unmapped: list[int], final: Sequence[int], lag: int, active: Sequence[int]
    ) -> None:
        """Leave all keyframes unmapped."""

    def refine(self, unmapped: list[int], progress: Progress, seconds: float | None) -> None:
        """Make the map from all keyframes; in limited ``seconds`` only if there is none yet."""
        if (seconds is not None and self.disks) or not (unmapped or self.disks):
            return
        with self.stopwatch("final mapping"):
            for id in unmapped:
                if id not in self.mapper.views:  # else it was interrupted after that
                    self.mapper.observe(id, self.mask.of(self.mapper.keyframes[id]))
            map_all(self.mapper, [*unmapped], progress, seconds)
        unmapped.clear()
