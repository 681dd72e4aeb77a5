"""Frames at once, everything else in threads; results then depend on the speed of the machine."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.concurrent import BackgroundTask
from geogs.executors.background_mapper import BackgroundMapper, wait_for
from geogs.executors.in_order import Advance, InOrder
from geogs.mapping.mapper import Mapper
from geogs.scene_mask import SceneMask
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.tracking.follower import Follower
from geogs.tracking.locate.pose_deviation import DeviationOf
from geogs.tracking.segment_trackers import Recall, Segments
from geogs.tracking.tracker import TrackResult
from geogs.types import Frame
from geogs.world.keyframes import KeyframeTable
from geogs.world.segments import TrackState

R = TypeVar("R")


class Live(InOrder):
    """Tracks in the caller's thread, completes keyframes in a second, and maps in a third.

    While a keyframe is being completed, frames are located by its earlier state. Other code must
    call :meth:`settle` before it uses the segments. On a GPU frames and keyframes share an urgent
    stream, to which that of mapping gives way.
    """

    def __init__(
        self,
        segments: Segments,
        mapper: Mapper,
        stopwatch: Stopwatch,
        mask: SceneMask,
        new_mapper: Callable[[KeyframeTable], Mapper],
        stream: "torch.cuda.Stream | None",
    ) -> None:
        """``new_mapper`` makes a mapper for a copy of the keyframes; ``stream`` is the urgent one,
        in which the segments' fields were made: see :func:`urgent_stream`."""
        super().__init__(segments, mapper, stopwatch, mask)
        self._stream = stream
        self.mapping = self._background = BackgroundMapper(mapper.keyframes, new_mapper)
        self._completion = BackgroundTask("keyframes")
        # Python's threads take turns every 5 ms, which would slow tracking several times a frame.
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(min(0.0001, self._switch_interval))
        self._follower: Follower | None = None

    # --- a frame -----------------------------------------------------------------------------

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Return a context for the processing of a frame, in which mapping gives way."""
        with self._background.giving_way(), torch.cuda.stream(self._stream):
            yield

    def track(self, frame: Frame, recall: Recall, advance: Advance) -> TrackState:
        """Locate a frame; all other work on it is done in the other threads."""
        with self.stopwatch("tracking"):
            follower = self._follower if self._completion.is_going_on else None
            if follower is not None and follower.follow(frame) is not None:
                return TrackState.TRACKING
        with self.stopwatch("waiting"):
            self.settle()
        with self.stopwatch("tracking"):
            tracked = self.segments.track(frame, recall)
        if self.segments.current.is_unfinished:
            self._follower = self.segments.current.follower()
            self._completion.start(partial(self._complete, tracked, advance))
        else:
            advance(tracked)
            wait_for(self._stream)  # other threads may read what it has written
        return tracked.state

    @property
    def is_completing(self) -> bool:
        """Whether a keyframe is being completed."""
        return self._completion.is_going_on

    @on_one_torch_thread
    def _complete(self, begun: TrackResult, advance: Advance) -> None:
        with torch.cuda.stream(self._stream), self.stopwatch.aside():
            result = self.segments.complete()
            advance(replace(result, finalized=(*begun.finalized, *result.finalized)))

    @property
    def T_cw(self) -> Float[Tensor, "4 4"] | None:
        """Last known pose, world to camera, in whatever segment; None before the first."""
        return super().T_cw if self._follower is None else self._follower.T_cw

    def deviation(self) -> DeviationOf | None:
        """Return a function for the last pose's standard deviations; None without a pose."""
        return super().deviation() if self._follower is None else self._follower.deviation()

    def settle(self) -> None:
        """Wait for the keyframe, and take over the frames that were located meanwhile."""
        self._completion.wait()
        if self._follower is None:
            return
        follower = self._follower
        self._follower = None
        with torch.cuda.stream(self._stream):
            self.segments.tracker_of(follower.last.keyframe).take_over(follower)
        wait_for(self._stream)

    def in_order(self) -> InOrder:
        """End all threads; return the executor for the stages after the last frame."""
        with self.stopwatch("mapping"):
            mapper = self._background.settled()
        sys.setswitchinterval(self._switch_interval)
        return InOrder(self.segments, mapper, self.stopwatch, self.mask)

    # --- the map -----------------------------------------------------------------------------

    @property
    def disks(self) -> int:
        """Disks in the map when a keyframe was last mapped."""
        return self._background.disks

    def _refine_poses(self, active: Sequence[int]) -> None:
        """Do nothing: tracking does not wait for the map."""

    def ask(self, question: Callable[[Mapper], R]) -> R:
        """Return the answer of the mapper, from its thread."""
        return self._background.ask(question)


def urgent_stream(device: str) -> "torch.cuda.Stream | None":
    """Return a GPU stream of high priority; None on a CPU."""
    where = torch.device(device)
    return torch.cuda.Stream(where, priority=-1) if where.type == "cuda" else None
