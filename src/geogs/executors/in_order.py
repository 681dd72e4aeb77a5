"""Stages one after the other, in the order of the frames; base of the other executors."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

from geogs.executors.background_mapper import BackgroundMapper
from geogs.mapping.map_all import map_all
from geogs.mapping.mapper import Mapper
from geogs.scene_mask import SceneMask
from geogs.stopwatch import Stopwatch
from geogs.tracking.locate.pose_deviation import DeviationOf
from geogs.tracking.segment_trackers import Recall, Segments
from geogs.tracking.tracker import TrackResult
from geogs.types import Frame
from geogs.world.segments import TrackState

R = TypeVar("R")

Advance = Callable[[TrackResult], None]
"""Closes loops, moves the map and maps, after what tracking changed."""
Progress = Callable[[float], None]
"""Called with the finished fraction in [0, 1]."""


class InOrder:
    """Runs every stage at once, so that results depend only on the frames."""

    maps_at_end = False
    """Whether there is no map until the stream has ended."""

    def __init__(
        self, segments: Segments, mapper: Mapper, stopwatch: Stopwatch, mask: SceneMask
    ) -> None:
        self.segments = segments
        self.mapper = mapper
        self.mapping: Mapper | BackgroundMapper = mapper
        """Takes keyframes and corrections: the mapper, or a thread that has one."""
        self.stopwatch = stopwatch
        self.mask = mask

    # --- a frame -----------------------------------------------------------------------------

    def frame(self) -> AbstractContextManager[object]:
        """Return a context for the processing of a frame."""
        return nullcontext()

    def track(self, frame: Frame, recall: Recall, advance: Advance) -> TrackState:
        """Track a frame and run the other stages on what that changed."""
        with self.stopwatch("tracking"):
            tracked = self.segments.track(frame, recall)
        advance(tracked)
        return tracked.state

    @property
    def T_cw(self) -> Float[Tensor, "4 4"] | None:
        """Last known pose, world to camera, in whatever segment; None before the first."""
        return self.segments.current.T_cw

    def deviation(self) -> DeviationOf | None:
        """Return a function for the last pose's standard deviations; None without a pose."""
        return self.segments.current.deviation()

    def settle(self) -> None:
        """Wait for work that the last frame started."""

    def in_order(self) -> "InOrder":
        """End all threads; return the executor for the stages after the last frame."""
        return self

    def begin_anew(self, mapper: Mapper) -> None:
        """Go on with a mapper that has no map yet."""
        self.mapper = self.mapping = mapper

    # --- the map -----------------------------------------------------------------------------

    @property
    def disks(self) -> int:
        """Disks in the map."""
        return len(self.mapper.table.disks)

    def map(
        self, unmapped: list[int], final: Sequence[int], lag: int, active: Sequence[int]
    ) -> None:
        """Map keyframes with at least ``lag`` final successors, and refine ``active`` poses.

        ``final`` are the newly final keyframes, the last of ``unmapped``. Mapped ones are removed
        from ``unmapped``.
        """
        with self.stopwatch("mapping"):
            for id in final:
                self.mapping.observe(id, self.mask.of(self.mapper.keyframes[id]))
            ready = unmapped[: max(len(unmapped) - lag, 0)]
            for id in ready:
                self.mapping.map_keyframe(id)
            del unmapped[: len(ready)]
        if ready:
            self._refine_poses(active)

    def _refine_poses(self, active: Sequence[int]) -> None:
        """Refine poses against the map, every ``pose_every`` keyframes."""
        config = self.mapper.config
        if config.pose_iterations and len(self.mapper.table.mapped) % config.pose_every == 0:
            with self.stopwatch("pose refinement"):
                self.mapper.refine_poses(active)

    def refine(self, unmapped: list[int], progress: Progress, seconds: float | None) -> None:
        """Train the map over all keyframes; not in limited time, as there already is a map."""
        if seconds is None and self.mapper.table.mapped and self.mapper.config.final_iterations:
            with self.stopwatch("final mapping"):
                if self.mapper.keyframes.lens is not None:
                    ids = list(self.mapper.views)
                    self.mapper.see_anew({i: self.mask.of(self.mapper.keyframes[i]) for i in ids})
                self.mapper.refine(progress)

    def ask(self, question: Callable[[Mapper], R]) -> R:
        """Return the answer of the mapper."""
        return question(self.mapper)


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
