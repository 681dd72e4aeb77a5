"""Tracking of one segment of video: frames in, keyframes with poses and inverse depth out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import Config
from geogs.errors import InputError, TrackingLost
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.priors.monocular_prior import MonocularPrior
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.follower import Follower
from geogs.tracking.frames.pose_filling import solve_trajectory
from geogs.tracking.keyframes.keyframe_choice import LATEST, KeyframeChoice, is_near_end
from geogs.tracking.keyframes.segment_map import SegmentMap
from geogs.tracking.local_mapping import LocalMapping, track_from_start
from geogs.tracking.locate.frame_locator import FrameMotion, Recognition
from geogs.tracking.locate.localiser import SegmentLocaliser
from geogs.tracking.locate.orientation_follower import OrientationFollower
from geogs.tracking.locate.pose_deviation import DeviationOf, deviation_of
from geogs.tracking.matching.flow_chain import MIN_TEXTURE
from geogs.tracking.start.start_up import StartUp
from geogs.types import Frame, Trajectory
from geogs.world.frames import FrameRecord, RelativeRotation
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeTable
from geogs.world.segments import LastFrame, TrackState, VideoSegment


@dataclass(frozen=True)
class TrackResult:
    """Changes after one frame."""

    state: TrackState
    finalized: tuple[int, ...] = ()
    """Ids that became final and will not be removed, earliest first."""
    active: tuple[int, ...] = ()
    """Ids whose poses the local adjustment still moves, earliest first."""
    finalized_elsewhere: tuple[int, ...] = ()
    """Ids that became final in a segment that is not the main map."""
    is_new_main: bool = False
    """Whether another segment became the main map; ``finalized`` then lists all its keyframes."""


@dataclass(frozen=True)
class _Unfinished:
    """A new keyframe with a pose only, and the motion by which it was located."""

    keyframe: Keyframe
    motion: FrameMotion
    rotations: Sequence[RelativeRotation]
    is_last: bool
    """Whether the video ends soon after it."""


class Tracker:
    """Monocular tracking after DROID-SLAM: motion filter, frame graph, dense bundle adjustment."""

    def __init__(
        self,
        segment: VideoSegment,
        operator: FlowOperator,
        config: Config,
        prior: MonocularPrior | None = None,
        defers: bool = False,
    ) -> None:
        """``segment`` is the state so far, changed in place. With ``defers`` new keyframes get only
        a pose until :meth:`complete` is called."""
        self.segment = segment
        self.keyframes = segment.keyframes
        self.config = config.tracking
        self.map = SegmentMap(segment, operator, config, prior)
        grid = self.keyframes.grid
        self._choice = KeyframeChoice(self.config, grid, segment.sharpness)
        self._start_up = StartUp(self.map, self._choice, self.config)
        self._localiser = SegmentLocaliser(self.map)
        self._orientation = OrientationFollower(grid, operator, self.config)
        self.local = LocalMapping(self.map, self.config)
        self._motion: FrameMotion | None = None
        """Motion by which the last frame was located; None where it was not."""
        self._defers = defers
        self._unfinished: _Unfinished | None = None

    # --- reading ---------------------------------------------------------------------------

    @property
    def T_cw(self) -> Float[Tensor, "4 4"] | None:
        """Last known pose, world to camera; None before the first."""
        last = self.segment.status.last
        return None if last is None else last.T_cw(self.keyframes[last.keyframe])

    @property
    def is_unfinished(self) -> bool:
        """Whether a new keyframe waits to be completed."""
        return self._unfinished is not None

    def deviation(self) -> DeviationOf | None:
        """Return a function for the deviations of the last pose relative to the keyframes around;
        None if it has no pose, or was located with others at the start."""
        motion = self._motion
        keyframes = self.keyframes
        if motion is None or motion.keyframe not in keyframes:
            return None
        return deviation_of(keyframes.grid, keyframes[motion.keyframe], motion)

    def trajectory(self, elsewhere: Sequence[FrameRecord] = ()) -> Trajectory:
        """Return the poses of all frames so far, solved on the present keyframes.

        Before the map is started, and always for frames ``elsewhere`` in other segments, only
        orientations are known.
        """
        has_map = self.segment.status.has_map
        return solve_trajectory(self.map.recorder.log, self.keyframes, elsewhere, has_map)

    def settle(self) -> None:
        """Wait until the segment includes all measurements of threads."""
        self._choice.settle()
        _ = self.map.recorder.log

    # --- the stream ------------------------------------------------------------------------

    def track(self, frame: Frame) -> TrackResult:
        """Track the next frame.

        Raises InputError if its size is not the camera's.
        """
        self._check_size(frame)
        status = self.segment.status
        self._motion = None
        self.map.recorder.note_rows(frame)
        encoded = self.map.operator.encode(frame.image)
        self._choice.see(frame.image)
        if self.map.operator.texture(encoded) < MIN_TEXTURE:
            return self._lose(frame)
        if not status.has_map:
            return self._initialise(frame, encoded)
        if status.state is TrackState.TRACKING:
            motion = self._localiser.track(frame, encoded)
            if motion is not None:
                return self._take(frame, encoded, motion)
        followed = self._orientation.follow(status.orientation, frame, encoded)
        rotations = [] if followed is None else [followed.rotation]
        motion = self._localiser.relocalise(encoded, followed)
        if motion is not None:
            return self._take(frame, encoded, motion, rotations)
        status.frames_lost += followed is None or not followed.is_pure
        return self._lose(frame, rotations)

    def rejoin(self, frame: Frame, recognised: Sequence[Recognition]) -> TrackResult | None:
        """Track the next frame from recognised keyframes; None if none of them locates it."""
        self.map.recorder.note_rows(frame)
        encoded = self.map.operator.encode(frame.image)
        motion = self._localiser.recognise(encoded, recognised)
        if motion is None:
            return None
        self.cut()
        return self._take(frame, encoded, motion)

    def cut(self) -> None:
        """Note that no motion links the next frame: the camera has to be relocalised."""
        self.segment.status.orientation.reset()
        if self.segment.status.has_map:
            self.segment.status.lose()

    def finish(self) -> TrackResult:
        """End the stream: every keyframe becomes final.

        Raises TrackingLost if the map could never be started.
        """
        if not self.segment.status.has_map:
            if not self._start_up.finish():
                raise TrackingLost(self._start_up.why_not())
            self._begin()
        ids = self.keyframes.ids
        fresh = self.map.finalise(ids)
        self.map.recorder.finalise(ids[-1], None)
        return TrackResult(self.segment.status.state, fresh)

    def absorb(self, other: "Tracker") -> None:
        """Take over the keyframes and frames of another tracker, already in this one's gauge.

        The camera's state is that of the later of the two. The other must not be used again.
        """
        own = self.segment
        theirs = other.segment
        ids = own.keyframes.ids
        guests = theirs.keyframes.ids
        breaks = {*own.breaks, *theirs.breaks, *[k for k in ids if k > guests[-1]][:1]}
        if guests[0] > ids[0]:
            breaks.add(guests[0])
        own.breaks[:] = sorted(breaks)
        if guests[-1] > ids[-1]:
            own.status = theirs.status
        own.final[:] = sorted([*own.final, *theirs.final])
        self.map.absorb(other.map)

    # --- frames that come while a keyframe is being completed ---------------------------------

    def follower(self) -> Follower:
        """Return a locator of frames for while another thread completes the keyframe."""
        new = self._unfinished
        last = self.segment.status.last
        assert new is not None, "no keyframe waits to be completed"
        assert last is not None
        keyframes = self.keyframes
        keyframe, anchor = (keyframes[k].as_it_is() for k in (last.keyframe, new.motion.keyframe))
        locator = self._localiser.locator
        return Follower(locator, self.config, replace(last), keyframe, anchor, new.motion)

    def take_over(self, follower: Follower) -> None:
        """Take over the frames that were followed while the keyframe was completed."""
        status = self.segment.status
        keyframe = self.keyframes[follower.last.keyframe]
        for found in follower.frames:
            T_rel = keyframe.at_present_scale(found.T_rel, follower.last.scale)
            self.map.recorder.add(
                found.frame, found.encoded, keyframe.id, T_rel, found.motion.match
            )
            self._orientation.located(status.orientation, found.frame, found.encoded)
            self._choice.see(found.frame.image)
        status.last = follower.last
        self._motion = None  # it belongs to the keyframe before its completion

    def complete(self) -> TrackResult:
        """Complete the new keyframe: neighbours, depth, local adjustment."""
        new = self._unfinished
        self._unfinished = None
        assert new is not None, "no keyframe waits to be completed"
        self.local.update(new.keyframe, new.motion.keyframe, new.rotations, not new.is_last)
        fresh = self.map.finalise(self.local.lasting)
        return TrackResult(self.segment.status.state, fresh, self.local.active)

    # --- steps of a frame ----------------------------------------------------------------------

    def _check_size(self, frame: Frame) -> None:
        height, width = frame.image.shape[:2]
        camera = self.keyframes.grid.camera
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"Frame {frame.index} is {width} x {height} pixels, the camera is "
                f"{camera.width} x {camera.height}; all frames must have one size."
            )

    def _initialise(self, frame: Frame, encoded: Any) -> TrackResult:
        """Process a frame while there is no map; it may start the map."""
        status = self.segment.status
        keyframes = self.keyframes
        rotations = []
        if not len(keyframes):
            followed = self._orientation.follow(status.orientation, frame, encoded)
            rotations = [] if followed is None else [followed.rotation]
        self._start_up.take(frame, encoded, rotations)
        if not status.has_map:
            return TrackResult(status.state)
        self._begin()
        self._orientation.located(status.orientation, frame, encoded)
        fresh = self.map.finalise(self.local.lasting)
        return TrackResult(status.state, fresh, self.local.active)

    def _begin(self) -> None:
        """Initialise tracking right after the map was started."""
        self.map.odometry.update_scale()
        track_from_start(self.local, self._localiser.locator)
        status = self.segment.status
        last = self.keyframes[self.keyframes.ids[-1]]
        status.last = LastFrame.at(last)
        after = [r for r in self.map.recorder.unplaced() if r.index > last.frame_index]
        if after:
            status.lose()
            status.misses = status.frames_lost = len(after)

    def _lose(self, frame: Frame, rotations: Sequence[RelativeRotation] = ()) -> TrackResult:
        """Log a frame without a pose, with an orientation only if there are ``rotations``."""
        status = self.segment.status
        if status.has_map:
            status.lose()
            status.misses += 1
        self.map.recorder.add_untracked(frame.index, frame.timestamp, rotations)
        state = TrackState.TURNING if rotations else status.state
        return TrackResult(state, active=self.local.active)

    def _take(
        self,
        frame: Frame,
        encoded: Any,
        motion: FrameMotion,
        rotations: Sequence[RelativeRotation] = (),
    ) -> TrackResult:
        """Log a located frame, or make it a keyframe if needed."""
        status = self.segment.status
        self._motion = motion
        anchor = self.keyframes[motion.keyframe]
        last = self._located(frame, motion)
        if status.state is TrackState.LOST:
            self.segment.breaks.append(self.keyframes.table.next_id)
        status.state = TrackState.TRACKING
        status.misses = 0
        status.frames_lost = 0
        status.last = last
        self._orientation.located(status.orientation, frame, encoded)
        # Where few frames have sensor depth, each of them is worth a keyframe.
        is_first_measured = (
            frame.depth is not None and self.segment.is_metric and anchor.measured is None
        )
        latest = (self.keyframes[k].frame_index for k in self.keyframes.ids[-LATEST:])
        ends = is_near_end(frame.left, latest)
        if not (is_first_measured or self._choice.calls_for(motion, ends)):
            self.map.recorder.add(frame, encoded, anchor.id, last.T_rel, motion.match, rotations)
            return TrackResult(status.state, active=self.local.active)
        keyframe = self.local.insert(frame, encoded, motion)
        status.last = LastFrame.at(keyframe, last.velocity, last.interval)
        self._unfinished = _Unfinished(keyframe, motion, rotations, ends)
        return TrackResult(status.state) if self._defers else self.complete()

    def _located(self, frame: Frame, motion: FrameMotion) -> LastFrame:
        """Return the pose of the frame, and the motion since the frame before."""
        status = self.segment.status
        anchor = self.keyframes[motion.keyframe]
        T_before = self.T_cw
        velocity = None
        interval = 0.0
        before = status.last
        is_tracking = status.state is TrackState.TRACKING
        if before is not None and T_before is not None and is_tracking:
            velocity = motion.T_cw @ se3_inverse(T_before)
            interval = frame.timestamp - before.timestamp
        T_rel = motion.T_cw @ se3_inverse(anchor.T_cw)
        return LastFrame(anchor.id, T_rel, velocity, anchor.scale, frame.timestamp, interval)


def lone_tracker(
    camera: Camera,
    config: Config | None = None,
    device: torch.device | str = "cpu",
    operator: FlowOperator | None = None,
    prior: MonocularPrior | None = None,
    defers: bool = False,
) -> Tracker:
    """Return a tracker of a video with one segment, without loops and without a map of disks."""
    grid = SampleGrid(camera, device)
    config = config or Config()
    operator = operator or build_operator(config.tracking, grid)
    segment = VideoSegment(keyframes=KeyframeTable.on(grid, operator.encode).new_set())
    return Tracker(segment, operator, config, prior, defers)
