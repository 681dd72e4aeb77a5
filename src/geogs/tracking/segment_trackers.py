"""Segments of video, each tracked separately until a loop joins it to the main map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.config import Config
from geogs.errors import TrackingLost
from geogs.priors.monocular_prior import MonocularPrior
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.locate.frame_locator import Recognition
from geogs.tracking.tracker import Tracker, TrackResult
from geogs.types import FoundFrames, Frame, Trajectory
from geogs.world.keyframes import KeyframeTable
from geogs.world.segments import (
    OrientationTrack,
    SegmentFate,
    SegmentTable,
    TrackState,
    VideoSegment,
)

Recall = Callable[[UInt8[np.ndarray, "h w 3"]], Sequence[Recognition]]
"""Recognises keyframes of any segment in an image; most similar first."""

MIN_ORIENTED = 0.5
"""Fraction of the frames whose orientation has to be known where positions are not: fewer mean
pictures of different scenes rather than a rotating camera."""


class Segments:
    """Trackers of the segments of a video, one of which is the main map.

    A camera that stays lost although images have texture starts a new segment, with its own gauge.
    Meanwhile every image is compared with the keyframes of all segments. Where one is recognised,
    tracking continues there, and the current segment is dropped if it has no map yet. One that has
    a map waits until a loop links it, and then becomes part of the main map.
    Source: the atlas of ORB-SLAM3 (Campos et al. 2021), with one map.
    """

    def __init__(
        self,
        table: SegmentTable,
        keyframes: KeyframeTable,
        operator: FlowOperator,
        config: Config,
        prior: MonocularPrior | None = None,
        defers: bool = False,
    ) -> None:
        """``table`` is the state so far, changed in place; ``defers`` as in :class:`Tracker`."""
        self.table = table
        self._keyframes = keyframes
        self._patience = config.tracking.patience
        self._new_tracker = partial(
            Tracker, operator=operator, config=config, prior=prior, defers=defers
        )
        self._trackers = {segment.number: self._new_tracker(segment) for segment in table.segments}
        if not table.segments:
            self._begin_segment()

    # --- reading ---------------------------------------------------------------------------

    @property
    def main(self) -> Tracker:
        """Tracker of the main map."""
        return self._trackers[self.table.main]

    @property
    def current(self) -> Tracker:
        """Tracker of the camera's present segment."""
        return self._trackers[self.table.current]

    @property
    def trackers(self) -> list[Tracker]:
        """All trackers, earliest first."""
        return list(self._trackers.values())

    @property
    def keyframe_ids(self) -> list[int]:
        """Ids of the main map's keyframes, earliest first."""
        return self.main.segment.ids

    def tracker_of(self, id: int) -> Tracker:
        """Return the tracker that has a keyframe. Raises KeyError if none does."""
        for tracker in self._trackers.values():
            if id in tracker.keyframes:
                return tracker
        raise KeyError(id)

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames so far; those of other segments count as not tracked."""
        others = [t for t in self.trackers if t is not self.main]
        return self.main.trajectory([r for t in others for r in t.map.recorder.log.records])

    def summary(self) -> list[SegmentFate]:
        """Return summaries of all segments with a map, earliest first."""
        present = [
            _fate(t, "world" if t is self.main else "apart")
            for t in self.trackers
            if t.segment.ids and t.segment.frames.records
        ]
        return sorted([*present, *self.table.joined], key=lambda s: s.first_time)

    def settle(self) -> None:
        """Wait until the table includes the results of all threads."""
        for tracker in self._trackers.values():
            tracker.settle()

    # --- writing ---------------------------------------------------------------------------

    def join(self, host: Tracker, guest: Tracker, S: Float[Tensor, "4 4"]) -> tuple[int, ...]:
        """Join a segment to another, given the Sim(3) from the host's gauge to the guest's.

        Returns the ids of the guest's keyframes that were final.
        """
        self.table.joined.append(_fate(guest, "joined"))
        guest.keyframes.correct(guest.keyframes.moved(S))
        final = tuple(guest.segment.final)
        host.absorb(guest)
        if self.current is guest:
            self.table.current = host.segment.number
        self._remove(guest)
        return final

    def place_found(self, found: FoundFrames) -> None:
        """Insert relocalised frames into the main map."""
        others = [t.map.recorder for t in self.trackers if t is not self.main]
        self.main.map.recorder.place_found(found, others)

    # --- the stream ------------------------------------------------------------------------

    def track(self, frame: Frame, recall: Recall) -> TrackResult:
        """Track the next frame; while the camera is lost, ``recall`` recognises keyframes in it.

        Raises InputError if its size is not the camera's.
        """
        final = self._cut() if frame.follows_cut else ()
        result = self._track(frame, recall)
        return replace(result, finalized=(*final, *result.finalized))

    def _cut(self) -> tuple[int, ...]:
        """Cut before the next frame, which no motion links; return ids that became final."""
        current = self.current
        if current.segment.status.has_map:
            current.cut()
            return ()
        try:
            final = current.finish().finalized
        except TrackingLost:  # too few frames to start with
            self._begin_segment()
            self._drop(current)
            return ()
        current.cut()
        return final if current is self.main else ()

    def _track(self, frame: Frame, recall: Recall) -> TrackResult:
        status = self.current.segment.status
        is_lost = status.state is TrackState.LOST
        if is_lost or (not status.has_map and len(self._trackers) > 1):
            result = self._rejoin(frame, recall(frame.image))
            if result is not None:
                return self._reported(result)
        if is_lost and (frame.follows_cut or status.frames_lost >= self._patience):
            self._begin_segment()
            if not frame.follows_cut:
                new = self.current.segment.status
                new.orientation = status.orientation
                status.orientation = OrientationTrack()
        return self._reported(self.current.track(frame))

    def complete(self) -> TrackResult:
        """Complete the new keyframe of a deferring tracker."""
        return self._reported(self.current.complete())

    def finish(self) -> TrackResult:
        """End the stream: every keyframe becomes final, and the largest segment the main map.

        Where no segment could be started, the orientations of most frames may be known; then
        ``why_not`` gives the reason. Raises TrackingLost if they are not.
        """
        finals: dict[Tracker, TrackResult] = {}
        for tracker in self.trackers:
            try:
                finals[tracker] = tracker.finish()
            except TrackingLost as reason:
                if len(self._trackers) > 1:
                    self._drop(tracker)
                    continue
                oriented = tracker.trajectory().oriented
                if oriented is None or not len(oriented) or oriented.mean() < MIN_ORIENTED:
                    raise
                self.table.why_not = str(reason)
                return TrackResult(tracker.segment.status.state)
        # A saved map is always the main one.
        largest = max(finals, key=lambda t: (bool(t.segment.fixed), len(t.keyframes)))
        if largest is self.main:
            return finals[largest]
        self.table.main = largest.segment.number
        return replace(finals[largest], finalized=tuple(largest.segment.final), is_new_main=True)

    def _rejoin(self, frame: Frame, recognised: Sequence[Recognition]) -> TrackResult | None:
        """Continue tracking where the frame was recognised, in whatever segment."""
        for tracker in self.trackers if recognised else ():
            if not tracker.segment.status.has_map:
                continue
            result = tracker.rejoin(frame, recognised)
            if result is not None:
                if not self.current.segment.status.has_map:
                    self._drop(self.current)
                self.table.current = tracker.segment.number
                return result
        return None

    # --- start and end of segments ---------------------------------------------------------

    def _begin_segment(self) -> None:
        """Start a new segment, whose keyframe ids follow all others."""
        segment = VideoSegment(self.table.count, self._keyframes.new_set())
        self.table.count += 1
        self.table.segments.append(segment)
        self.table.current = segment.number
        self._trackers[segment.number] = self._new_tracker(segment)

    def _drop(self, tracker: Tracker) -> None:
        """Drop a segment that has no map."""
        is_current = tracker is self.current
        self._remove(tracker)
        if self.table.main == tracker.segment.number:
            self.table.main = self.table.segments[0].number
        if is_current:
            self.table.current = self.table.main
        self.main.map.recorder.give_up(tracker.map.recorder)

    def _remove(self, tracker: Tracker) -> None:
        self.table.segments.remove(tracker.segment)
        del self._trackers[tracker.segment.number]

    def _reported(self, result: TrackResult) -> TrackResult:
        """Reduce the result of a segment that is not the main map to what is final."""
        if self.current is self.main:
            return result
        return TrackResult(result.state, finalized_elsewhere=result.finalized)


def _fate(tracker: Tracker, fate: Literal["world", "joined", "apart"]) -> SegmentFate:
    times = [r.timestamp for r in tracker.segment.frames.records]
    return SegmentFate(min(times), max(times), len(tracker.keyframes), fate)
