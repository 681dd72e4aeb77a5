"""Stretches of video that no motion links: each tracked on its own until one place joins them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.errors import TrackingLost
from geogs.tracking.follower import Follower
from geogs.tracking.motion import Recognition
from geogs.tracking.tracker import Tracker, TrackerState, TrackResult, TrackState
from geogs.types import Frame, Trajectory

Recall = Callable[[UInt8[np.ndarray, "h w 3"]], Sequence[Recognition]]
"""Recognises keyframes of any segment in an image; most alike first."""


LEAST_ORIENTED = 0.5
"""Share of the frames whose orientation has to be known where nothing else is: fewer are pictures
of different things rather than a camera that turns."""


@dataclass(frozen=True)
class SegmentFate:
    """What became of one stretch of video."""

    first_time: float
    """Seconds."""
    last_time: float
    keyframes: int
    """It had when it was joined, or at the end."""
    fate: Literal["world", "joined", "apart"]
    """The first of the map, joined to it, or never: then its frames count as not tracked."""


@dataclass(frozen=True, eq=False)
class SegmentsState:
    """What a checkpoint holds of segments."""

    trackers: list[TrackerState]
    world: int
    """Its place among the trackers."""
    current: int
    joined: list[SegmentFate]
    why_not: str


class Segments:
    """Trackers of stretches of video, one of which is the world that the map shows.

    A camera that stays lost although there is something to see starts a new segment, with a frame
    and unit of its own. Meanwhile every image is compared with the keyframes of all segments: where
    one is recognised, tracking goes on there, and a segment that has not been started is dropped.
    One that has been waits until a loop says where it lies, and then becomes part of the world.
    Source: the atlas of ORB-SLAM3 (Campos et al. 2021), with one map.
    """

    def __init__(self, start: Callable[[], Tracker], patience: int) -> None:
        """``start`` makes a tracker whose keyframe ids follow all others'; a segment begins after
        ``patience`` frames with texture in which nothing was recognised."""
        self._start, self._patience = start, patience
        self.world = start()
        self.current = self.world
        """Where the camera is."""
        self.trackers = [self.world]
        """The world and the segments that are apart, earliest first."""
        self._joined: list[SegmentFate] = []
        self.why_not = ""
        """Why no segment could be started, once the stream has ended; empty if one could."""

    # --- reading ---------------------------------------------------------------------------

    @property
    def keyframe_ids(self) -> list[int]:
        """Ids of the world's keyframes, earliest first."""
        return self.world.keyframe_ids

    @property
    def active(self) -> tuple[int, ...]:
        """Ids of the world's keyframes whose poses the local adjustment moves, earliest first."""
        return self.world.active

    def tracker_of(self, id: int) -> Tracker:
        """The tracker that holds a keyframe. Raises KeyError if none does."""
        for tracker in self.trackers:
            if id in tracker.keyframes:
                return tracker
        raise KeyError(id)

    def trajectory(self) -> Trajectory:
        """Poses of all frames seen so far; those of segments apart count as not tracked."""
        apart = [t.recorder for t in self.trackers if t is not self.world]
        return self.world.trajectory([r for recorder in apart for r in recorder.records])

    def summary(self) -> list[SegmentFate]:
        """All segments so far that were started, earliest first."""
        present = [
            _segment(t, "world" if t is self.world else "apart")
            for t in self.trackers
            if t.keyframe_ids and t.recorder.records
        ]
        return sorted([*present, *self._joined], key=lambda s: s.first_time)

    # --- checkpoints -----------------------------------------------------------------------

    def state(self) -> SegmentsState:
        """What a checkpoint holds."""
        at = {tracker: n for n, tracker in enumerate(self.trackers)}
        trackers = [tracker.full_state() for tracker in self.trackers]
        return SegmentsState(trackers, at[self.world], at[self.current], self._joined, self.why_not)

    def load(self, state: SegmentsState) -> None:
        """Give segments that have seen nothing yet the state of others."""
        self.trackers = [self.world, *(self._start() for _ in state.trackers[1:])]
        for tracker, saved in zip(self.trackers, state.trackers, strict=True):
            tracker.load(saved)
        self.world, self.current = self.trackers[state.world], self.trackers[state.current]
        self._joined, self.why_not = state.joined, state.why_not

    # --- writing ---------------------------------------------------------------------------

    def join(self, host: Tracker, guest: Tracker, S: Float[Tensor, "4 4"]) -> tuple[int, ...]:
        """Make a segment part of another, given the Sim(3) from the host's world to the guest's.

        Returns the ids of the guest's keyframes that were final.
        """
        self._joined.append(_segment(guest, "joined"))
        guest.keyframes.correct(guest.keyframes.moved(S))
        final = guest.finalized
        host.absorb(guest)
        self.trackers.remove(guest)
        if self.current is guest:
            self.current = host
        return final

    # --- the stream ------------------------------------------------------------------------

    def track(self, frame: Frame, recall: Recall) -> TrackResult:
        """Take the next frame; ``recall`` is asked where it is while the camera is lost.

        Raises InputError if its size is not the camera's.
        """
        final = self._cut() if frame.follows_cut else ()
        result = self._track(frame, recall)
        return replace(result, finalized=(*final, *result.finalized))

    def _cut(self) -> tuple[int, ...]:
        """No motion links the next frame to those before it; ids that thereby became final."""
        current = self.current
        if current.state is not TrackState.INITIALIZING:
            current.cut()
            return ()
        try:
            final = current.finish().finalized
        except TrackingLost:  # too few frames to start with
            self.current = self._start()
            self.trackers.append(self.current)
            self._drop(current)
            return ()
        current.cut()
        return final if current is self.world else ()

    def _track(self, frame: Frame, recall: Recall) -> TrackResult:
        if self._is_searching:
            result = self._rejoin(frame, recall(frame.image))
            if result is not None:
                return self._report(result)
        lost = self.current.state is TrackState.LOST
        if lost and (frame.follows_cut or self.current.frames_lost >= self._patience):
            before, self.current = self.current, self._start()
            self.trackers.append(self.current)
            if not frame.follows_cut:
                self.current.orientation = before.orientation
        return self._report(self.current.track(frame))

    def complete(self) -> TrackResult:
        """What a new keyframe of a tracker that defers takes beyond its place."""
        return self._report(self.current.complete())

    def take(self, follower: Follower) -> None:
        """Take over the frames that were followed meanwhile."""
        self.tracker_of(follower.last.keyframe.id).take(follower)

    def finish(self) -> TrackResult:
        """End of the stream: every keyframe becomes final, and the largest segment the world.

        Where no segment could be started but the orientations of most frames are known, these are
        what is left, and ``why_not`` says why. Raises TrackingLost if not even they are.
        """
        finals: dict[Tracker, TrackResult] = {}
        for tracker in list(self.trackers):
            try:
                finals[tracker] = tracker.finish()
            except TrackingLost as reason:
                if len(self.trackers) > 1:
                    self._drop(tracker)
                    continue
                trajectory = tracker.trajectory()
                oriented = trajectory.oriented
                if oriented is None or oriented.mean() < LEAST_ORIENTED:
                    raise
                self.why_not = str(reason)
                return TrackResult(tracker.state)
        # A saved map is the world whatever else there is.
        largest = max(finals, key=lambda t: (bool(t.held), len(t.keyframes)))
        if largest is self.world:
            return finals[largest]
        self.world = largest
        return replace(finals[largest], finalized=largest.finalized, is_new_world=True)

    @property
    def _is_searching(self) -> bool:
        is_starting = self.current.state is TrackState.INITIALIZING
        return self.current.state is TrackState.LOST or (is_starting and len(self.trackers) > 1)

    def _rejoin(self, frame: Frame, places: Sequence[Recognition]) -> TrackResult | None:
        """Go on where the frame was recognised, in whatever segment."""
        for tracker in self.trackers if places else ():
            if tracker.state is TrackState.INITIALIZING:
                continue
            result = tracker.rejoin(frame, places)
            if result is not None:
                if self.current.state is TrackState.INITIALIZING:
                    self._drop(self.current)
                self.current = tracker
                return result
        return None

    def _drop(self, tracker: Tracker) -> None:
        """Give up a segment that has not been started."""
        self.trackers.remove(tracker)
        if tracker is self.world:
            self.world = self.trackers[0]
        if tracker is self.current:
            self.current = self.world
        self.world.recorder.give_up(tracker.recorder)

    def _report(self, result: TrackResult) -> TrackResult:
        """What the world is told: of segments apart, only what is final."""
        if self.current is self.world:
            return result
        return TrackResult(result.state, apart=result.finalized)


def _segment(tracker: Tracker, fate: Literal["world", "joined", "apart"]) -> SegmentFate:
    times = [r.timestamp for r in tracker.recorder.records]
    return SegmentFate(min(times), max(times), len(tracker.keyframes), fate)
