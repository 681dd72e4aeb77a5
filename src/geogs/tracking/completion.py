"""Completes the keyframes of a live system beside the frames that come meanwhile."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.beside import Errand
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.tracking.follower import Follower
from geogs.tracking.pose_deviation import PoseDeviation
from geogs.tracking.segments import Segments
from geogs.tracking.tracker import TrackResult
from geogs.types import Frame


class Completion:
    """Does in a thread what a keyframe takes beyond its place, and finds frames until that is done.

    Nobody else may touch the segments while it is going on: :meth:`settle` comes first.
    """

    def __init__(
        self,
        segments: Segments,
        act_on: Callable[[TrackResult], None],
        stopwatch: Stopwatch,
        stream: "torch.cuda.Stream | None",
    ) -> None:
        """``act_on`` is told, in the thread, what a complete keyframe changed; all work on a GPU is
        done in ``stream``, as frames are."""
        self._segments, self._act_on = segments, act_on
        self._stopwatch, self._stream = stopwatch, stream
        self._errand = Errand("keyframes")
        self._follower: Follower | None = None

    @property
    def is_going_on(self) -> bool:
        """Whether a keyframe is being completed."""
        return self._errand.is_going_on

    @property
    def T_cw(self) -> Float64[Tensor, "4 4"] | None:
        """World to camera where the camera was last seen, in whatever segment; none before that."""
        if self._follower is not None:
            return self._follower.T_cw
        return self._segments.current.T_cw

    def deviation(self) -> PoseDeviation | None:
        """How well the last frame's pose is known relative to the map around; none without one."""
        if self._follower is not None:
            return self._follower.deviation()
        return self._segments.current.deviation()

    def begin(self, result: TrackResult) -> None:
        """Complete the keyframe that the last frame has become; ``result`` came with the frame."""
        self._follower = self._segments.current.follower()
        self._errand.start(partial(self._complete, result))

    def follow(self, frame: Frame) -> bool:
        """Find a frame while a keyframe is being completed; false where it has to be waited for."""
        if self._follower is None or not self._errand.is_going_on:
            return False
        return self._follower.follow(frame) is not None

    def settle(self) -> None:
        """Wait for the keyframe, and take over the frames that were found meanwhile."""
        self._errand.wait()
        if self._follower is None:
            return
        follower, self._follower = self._follower, None
        with torch.cuda.stream(self._stream):
            self._segments.tracker_of(follower.last.keyframe).take_over(follower)
        if self._stream is not None:
            self._stream.synchronize()  # others may read it from their streams

    @on_one_torch_thread
    def _complete(self, begun: TrackResult) -> None:
        with torch.cuda.stream(self._stream), self._stopwatch.aside():
            result = self._segments.complete()
            finalized = (*begun.finalized, *result.finalized)
            self._act_on(replace(result, finalized=finalized))
