"""The front end: frames in, keyframes with poses and inverse depth out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.base import BundleOptions
from geogs.bundle.select import grid_fields
from geogs.config import DepthSensorConfig, OdometryConfig, PriorConfig, TrackingConfig
from geogs.errors import InputError, TrackingLost
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.priors.base import MonocularPrior
from geogs.tracking.back_fill import back_fill
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.flow.select import build_operator
from geogs.tracking.follower import Follower
from geogs.tracking.graph import EdgeState, FrameGraph
from geogs.tracking.held import add_held
from geogs.tracking.keyframe_choice import KeyframeChoice
from geogs.tracking.keyframe_priors import KeyframePriors
from geogs.tracking.last_frame import LastFrame, LastFrameState
from geogs.tracking.motion import (
    FrameLocator,
    FrameMotion,
    Recognition,
)
from geogs.tracking.moving import carried
from geogs.tracking.odometry import Odometry, OdometryState
from geogs.tracking.orientation_chain import Followed, OrientationChain, OrientationState
from geogs.tracking.pose_deviation import PoseDeviation, pose_deviation
from geogs.tracking.proximity import Pair, frame_distances, proximity_pairs
from geogs.tracking.sensing import DepthSensing, stands_alone
from geogs.tracking.start_up import MIN_KEYFRAMES, StartUp, StartUpState
from geogs.tracking.trajectory import FrameRecord, RecorderState, TrajectoryRecorder
from geogs.tracking.turns import Turn
from geogs.tracking.view_choice import seeing
from geogs.tracking.window import reach
from geogs.types import Frame, RenderedKeyframe, Trajectory
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet, KeyframeTable, check_keyframes

SELDOM = 5
"""While a camera only turns, the orientation says what it sees; only so often it is looked for as
if it could be anywhere."""


class TrackState(Enum):
    """What the tracker is doing."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    TURNING = "orientation only"
    """There is a map, but too little of it in view: where the camera is cannot be told."""
    LOST = "lost"


@dataclass(frozen=True)
class TrackResult:
    """What one frame changed."""

    state: TrackState
    new_keyframe: int | None = None
    """Id of the keyframe made from this frame."""
    finalized: tuple[int, ...] = ()
    """Ids that from now on are never removed, earliest first."""
    active: tuple[int, ...] = ()
    """Ids whose poses the local adjustment still moves, earliest first."""
    removed: tuple[int, ...] = ()
    """Ids that were culled."""
    apart: tuple[int, ...] = ()
    """Ids that became final in a segment which is not part of the world."""
    is_new_world: bool = False
    """Whether another segment became the world; what is final is all of it."""


@dataclass(frozen=True)
class Unfinished:
    """A keyframe that nothing but its place is known of, and what it was located by."""

    keyframe: Keyframe
    anchor: int
    """Keyframe at which it was located."""
    motion: FrameMotion
    turns: Sequence[Turn]


@dataclass(frozen=True, eq=False)
class TrackerState:
    """What a checkpoint holds of a tracker."""

    keyframes: KeyframeSet
    edges: dict[Pair, EdgeState]
    recorder: RecorderState
    start_up: StartUpState
    state: TrackState
    finalized: list[int]
    breaks: list[int]
    last: LastFrameState | None
    misses: int
    frames_lost: int
    sharpness: list[float]
    """Of the latest frames."""
    orientation: OrientationState
    is_metric: bool
    odometry: OdometryState


class Tracker:
    """Monocular tracking after DROID-SLAM: motion filter, frame graph, dense bundle adjustment."""

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig | None = None,
        device: torch.device | str = "cpu",
        seed: int = 0,
        operator: FlowOperator | None = None,
        prior: MonocularPrior | None = None,
        prior_config: PriorConfig | None = None,
        store: KeyframeTable | None = None,
        sensor: DepthSensorConfig | None = None,
        odometry: OdometryConfig | None = None,
        defers: bool = False,
    ) -> None:
        """``store`` is where the keyframes are kept, in a segment of their own. One that ``defers``
        leaves to :meth:`complete` what a new keyframe takes beyond its place."""
        cv2.setRNGSeed(seed)
        self.camera = camera
        self.config = config or TrackingConfig()
        self.grid = SampleGrid(camera, device) if store is None else store.grid
        self.operator = operator or build_operator(self.config, self.grid)
        self.keyframes = (store or KeyframeTable.on(self.grid, self.operator.encode)).new_set()
        self.odometry = Odometry(self.keyframes, odometry or OdometryConfig())
        """What another tracker says of the motion, where frames come with its poses."""
        self.graph = FrameGraph(self.keyframes, self.operator, self.odometry)
        self.priors = KeyframePriors(self.graph, prior, prior_config or PriorConfig())
        self.sensing = DepthSensing(self.grid, sensor or DepthSensorConfig())
        self.is_metric = False
        """Whether a depth sensor started the map, which then is in metres."""
        self.recorder = TrajectoryRecorder(self.keyframes, self.operator)
        self.state = TrackState.INITIALIZING
        edge = max(camera.width, camera.height)
        self._long_edge = edge
        self._choice = KeyframeChoice(self.config, edge)
        self._locator = FrameLocator(
            self.grid,
            self.operator,
            self.config.min_matched,
            self.config.max_residual * edge,
            self.config.min_ncc,
        )
        self._finalized: dict[int, None] = {}
        self.held: frozenset[int] = frozenset()
        """Keyframes of a saved map, in whose world this one goes on: they stay as they are."""
        self._breaks: list[int] = []
        """Keyframes that no motion links to the one before them."""
        self._last: LastFrame | None = None
        self._motion: FrameMotion | None = None
        """By which the last frame was located; none where it was not."""
        self._defers = defers
        self._unfinished: Unfinished | None = None
        self._start_up = StartUp(self.graph, self.recorder, self.priors, self.config, self._choice)
        self.orientation = OrientationChain(self.grid, self.operator, self.config)
        """How the camera has turned since it was last located."""
        self._misses = 0
        self.frames_lost = 0
        """Frames with texture since the camera was last located, once the map has been started,
        but for those that only turned."""

    # --- reading ---------------------------------------------------------------------------

    @property
    def keyframe_ids(self) -> list[int]:
        """Ids of all keyframes, earliest first; empty until the map has been started."""
        return [] if self.state is TrackState.INITIALIZING else self.keyframes.ids

    @property
    def finalized(self) -> tuple[int, ...]:
        """Ids that are never removed any more, earliest first."""
        return tuple(self._finalized)

    def trajectory(self, apart: Sequence[FrameRecord] = ()) -> Trajectory:
        """Poses of all frames seen so far, solved on the present keyframes.

        Before the map is started no more than orientations is known, and of frames ``apart`` no
        more than that ever.
        """
        has_map = self.state is not TrackState.INITIALIZING
        return self.recorder.solve(apart, has_map=has_map)

    @property
    def active(self) -> tuple[int, ...]:
        """Ids whose poses the local adjustment moves, earliest first; never the very first."""
        ids = self.keyframe_ids
        fixed = self.held or {*ids[:1]}
        return tuple(k for k in ids[-self._reach() :] if k not in fixed)

    @property
    def deep(self) -> list[int]:
        """Ids whose inverse depth it moves, earliest first."""
        c = self.config
        latest = self.keyframes.ids[-(self._reach() + c.depth_window - c.window) :]
        return [k for k in latest if k not in self.held]

    @property
    def free(self) -> list[int]:
        """Ids of the keyframes that adjustments of all move, earliest first."""
        return [k for k in self.keyframe_ids if k not in self.held]

    def _reach(self) -> int:
        c = self.config
        return reach(list(self.keyframes), c.window, c.window_most, c.window_baseline)

    # --- checkpoints -----------------------------------------------------------------------

    def full_state(self) -> TrackerState:
        """What a checkpoint holds; ``state`` is only what the tracker is doing."""
        seen, last = self._last, None
        if seen is not None:
            last = LastFrameState(
                seen.keyframe.id, seen.T_rel, seen.velocity, seen.scale, seen.timestamp,
                seen.interval,
            )  # fmt: skip
        return TrackerState(
            self.keyframes, self.graph.state(), self.recorder.state(),
            self._start_up.state(), self.state, list(self._finalized), self._breaks, last,
            self._misses, self.frames_lost, self._choice.state(), self.orientation.state(),
            self.is_metric, self.odometry.state(),
        )  # fmt: skip

    def load(self, state: TrackerState) -> None:
        """Give a tracker that has seen nothing yet the state of another."""
        check_keyframes(self.keyframes.table, [state.keyframes])
        self.keyframes.members = state.keyframes.members
        self.keyframes.attached(self.keyframes.table)
        self.graph.load(state.edges)
        self.recorder.load(state.recorder)
        self._start_up.load(state.start_up)
        self.state, self.is_metric = state.state, state.is_metric
        self._finalized, self._breaks = dict.fromkeys(state.finalized), state.breaks
        self._misses, self.frames_lost = state.misses, state.frames_lost
        self._choice.load(state.sharpness)
        self.orientation.load(state.orientation)
        self.odometry.load(state.odometry)
        if state.last is not None:
            last = state.last
            keyframe = self.keyframes[last.keyframe]
            self._last = LastFrame(
                keyframe, last.T_rel, last.velocity, last.scale, last.timestamp, last.interval
            )

    @property
    def is_unfinished(self) -> bool:
        """Whether a new keyframe waits to be completed."""
        return self._unfinished is not None

    @property
    def T_cw(self) -> Float[Tensor, "4 4"] | None:
        """World to camera where the camera was last seen; none before that."""
        return None if self._last is None else self._last.T_cw

    def deviation(self) -> PoseDeviation | None:
        """How well the last frame's pose is known relative to the keyframes around; none if it has
        no pose, or was placed with others at the start."""
        motion = self._motion
        if motion is None or motion.keyframe not in self.keyframes:
            return None
        anchor = self.keyframes[motion.keyframe]
        return pose_deviation(self.grid, anchor, motion.T_cw, motion.match)

    # --- writing ---------------------------------------------------------------------------

    def hold(self, places: Sequence[RenderedKeyframe]) -> list[int]:
        """Begin in the world of a saved map, whose keyframes stay as they are; returns their ids.

        The camera is lost there until a frame is recognised at one of them.
        """
        ids = [add_held(self.keyframes, place, n - len(places)) for n, place in enumerate(places)]
        self.held = frozenset(ids)
        self._finalized = dict.fromkeys(ids)
        self.state = TrackState.LOST
        return ids

    def absorb(self, other: "Tracker") -> None:
        """Take over the keyframes and frames of another tracker, already in this one's world.

        The camera is where the later of the two saw it last. The other is of no more use.
        """
        if other.keyframes.ids[0] > self.keyframes.ids[0]:
            self._breaks.append(other.keyframes.ids[0])
        after = [k for k in self.keyframes.ids if k > other.keyframes.ids[-1]]
        self._breaks = sorted({*self._breaks, *other._breaks, *after[:1]})
        if other.keyframes.ids[-1] > self.keyframes.ids[-1]:
            self.state, self._misses = other.state, other._misses
            self._last, self.orientation = other._last, other.orientation
            self.frames_lost = other.frames_lost
        self._finalized = dict.fromkeys(sorted([*self._finalized, *other._finalized]))
        self.keyframes.absorb(other.keyframes)
        self.graph.edges = dict(sorted({**self.graph.edges, **other.graph.edges}.items()))
        self.recorder.absorb(other.recorder)

    # --- the stream ------------------------------------------------------------------------

    def track(self, frame: Frame) -> TrackResult:
        """Take the next frame.

        Raises InputError if its size is not the camera's.
        """
        height, width = frame.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"Frame {frame.index} is {width} x {height} pixels, the camera is "
                f"{self.camera.width} x {self.camera.height}; all frames must have one size."
            )
        self._motion = None
        self.recorder.see(frame)
        encoded = self.operator.encode(frame.image)
        self._choice.see(frame.image)
        if self.operator.texture(encoded) < self.config.min_texture:
            return self._lose(frame)
        if self.state is TrackState.INITIALIZING:
            return self._start(frame, encoded)
        motion = self._expected(frame, encoded)
        if motion is not None and motion.known >= self.config.min_known:
            return self._follow(frame, encoded, motion)
        followed = self.orientation.follow(frame, encoded)
        motion = self._found_again(encoded, followed)
        if motion is not None:
            return self._follow(frame, encoded, motion, followed)
        self.frames_lost += followed is None or not followed.is_pure
        return self._lose(frame, followed)

    def rejoin(self, frame: Frame, places: Sequence[Recognition]) -> TrackResult | None:
        """Take the next frame, which was recognised at one of some keyframes; None if it was not.

        A place is believed where the dense flow agrees with it over ``recognised`` of the cells.
        """
        self.recorder.see(frame)
        encoded = self.operator.encode(frame.image)
        for place in places:
            if place.keyframe not in self.keyframes:
                continue
            keyframe = self.keyframes[place.keyframe]
            guess = place.T_rel.to(keyframe.T_cw) @ keyframe.T_cw
            motion = self._locator.locate(keyframe, encoded, guess, is_expected=False)
            if motion is None or motion.known < self.config.min_known:
                continue
            if motion.matched >= self.config.recognised:
                self.cut()
                return self._follow(frame, encoded, motion)
        return None

    def cut(self) -> None:
        """No motion links the next frame to those before it; the camera has to be found anew."""
        self.orientation.forget()
        if self.state is not TrackState.INITIALIZING:
            self._lost()

    def finish(self) -> TrackResult:
        """End of the stream: every keyframe becomes final.

        Raises TrackingLost if the map could never be started.
        """
        if self.state is TrackState.INITIALIZING:
            if not self._start_up.finish():
                raise TrackingLost(self._start_up.why_not())
            self._begin()
        fresh = self._finalise(self.keyframes.ids)
        self.recorder.finalise(self.keyframes.ids[-1], None)
        return TrackResult(self.state, None, fresh, ())

    def _start(self, frame: Frame, encoded: Any) -> TrackResult:
        turns = []
        if not len(self.keyframes):
            followed = self.orientation.follow(frame, encoded)
            turns = [] if followed is None else [followed.turn]
        if frame.depth is not None and (result := self._start_metric(frame, encoded, turns)):
            return result
        step = self._start_up.take(frame, encoded, turns)
        if not step.has_started:
            return TrackResult(self.state, removed=step.removed)
        self._begin()
        self.orientation.located(frame, encoded)
        newest = self.keyframes.ids[-1] if step.is_keyframe else None
        fresh = self._finalise(self.keyframes.ids[:-1])
        return TrackResult(self.state, newest, fresh, self.active, step.removed)

    def _start_metric(
        self, frame: Frame, encoded: Any, turns: Sequence[Turn]
    ) -> TrackResult | None:
        """Start the map at once from what a depth sensor saw; None where that is too little."""
        eye = torch.eye(4, dtype=torch.float64)
        earlier = list(self.keyframes.ids)
        state = self.keyframes.add(frame.index, frame.timestamp, frame.image, encoded, eye)
        state.pose = frame.pose
        if not self.sensing.start(state, frame.depth, self.config.min_known):
            self.keyframes.remove(state.id)
            return None
        removed = self._start_up.give_up(earlier)
        self.priors.ask(state)
        self.recorder.add_keyframe(state.id, turns)
        self.is_metric = True
        self._begin()
        self.orientation.located(frame, encoded)
        return TrackResult(self.state, state.id, removed=removed)

    def _begin(self) -> None:
        self.state = TrackState.TRACKING
        self.odometry.look()
        back_fill(self.recorder, self._locator, self.config.min_known)
        self._seen_at(self.keyframes[self.keyframes.ids[-1]])

    # --- with a map ------------------------------------------------------------------------

    def _expected(self, frame: Frame, encoded: Any) -> FrameMotion | None:
        """The frame near where the last one was; None if the camera is not there, or was lost."""
        last = self._last
        if last is None or self.state is not TrackState.TRACKING:
            return None
        motion = self._locator.locate(last.keyframe, encoded, last.predicted(frame.timestamp))
        told = self.odometry.since(last.keyframe, frame.pose) if motion is None else None
        if told is not None:
            motion = self._locator.locate(last.keyframe, encoded, told @ last.keyframe.T_cw)
        if motion is None and last.velocity is not None:
            motion = self._locator.locate(last.keyframe, encoded, last.T_cw)
        return motion

    def _found_again(self, encoded: Any, followed: Followed | None) -> FrameMotion | None:
        """The frame anywhere: first where the camera would be if it had only turned."""
        last = self._last
        if last is not None and followed is not None and followed.R is not None:
            turn = torch.eye(4, dtype=torch.float64)
            turn[:3, :3] = followed.R
            guess = turn @ last.T_cw
            for keyframe in seeing(list(self.keyframes), guess):
                motion = self._locator.locate(keyframe, encoded, guess, is_expected=False)
                if motion is not None and motion.known >= self.config.min_known:
                    return motion
            if followed.is_pure and self._misses % SELDOM:
                return None
        motion = self._locator.relocate_any(self._places(), encoded)
        return None if motion is None or motion.known < self.config.min_known else motion

    def _lost(self) -> None:
        self.state = TrackState.LOST
        if self._last is not None:
            self._last = replace(self._last, velocity=None)

    def _seen_at(
        self,
        keyframe: Keyframe,
        T_rel: Float[Tensor, "4 4"] | None = None,
        velocity: Float[Tensor, "4 4"] | None = None,
        timestamp: float | None = None,
        interval: float = 0.0,
    ) -> None:
        """Note where the last frame was: relative to a keyframe, or at it."""
        T_rel = torch.eye(4, dtype=torch.float64) if T_rel is None else T_rel
        seconds = keyframe.timestamp if timestamp is None else timestamp
        self._last = LastFrame(keyframe, T_rel, velocity, keyframe.scale, seconds, interval)

    def _places(self) -> list[Keyframe]:
        """Where to look for a lost camera: recent keyframes, and older ones in turn."""
        count, states = self.config.relocalise, list(self.keyframes)
        recent, older = states[: -count - 1 : -1], states[:-count]
        turn = (self._misses * count) % max(len(older), 1)
        return recent + (older[turn:] + older[:turn])[:count]

    def _lose(self, frame: Frame, followed: Followed | None = None) -> TrackResult:
        """The frame has no pose; no orientation, either, unless it was ``followed``."""
        if self.state is not TrackState.INITIALIZING:
            self._lost()
            self._misses += 1
        if followed is None:
            self.recorder.add_untracked(frame.index, frame.timestamp)
            return TrackResult(self.state, active=self.active)
        self.recorder.add_untracked(frame.index, frame.timestamp, [followed.turn])
        return TrackResult(TrackState.TURNING, active=self.active)

    def _follow(
        self, frame: Frame, encoded: Any, motion: FrameMotion, followed: Followed | None = None
    ) -> TrackResult:
        velocity, interval, self._motion = None, 0.0, motion
        if self._last is not None and self.state is TrackState.TRACKING:
            velocity = motion.T_cw @ se3_inverse(self._last.T_cw)
            interval = frame.timestamp - self._last.timestamp
        if self.state is TrackState.LOST:
            self._breaks.append(self.keyframes.table.next_id)
        self.state, self._misses, self.frames_lost = TrackState.TRACKING, 0, 0
        self.orientation.located(frame, encoded)
        anchor = self.keyframes[motion.keyframe]
        T_rel = motion.T_cw @ se3_inverse(anchor.T_cw)
        self._seen_at(anchor, T_rel, velocity, frame.timestamp, interval)
        turns = [] if followed is None else [followed.turn]
        # Where few frames were measured, each of these is worth a keyframe.
        is_first_measured = frame.depth is not None and self.is_metric and anchor.measured is None
        if not (is_first_measured or self._choice.calls_for(motion.flow, motion.overlap)):
            self.recorder.add(frame, encoded, anchor.id, T_rel, motion.match, turns)
            return TrackResult(self.state, active=self.active)
        return self._insert(frame, encoded, motion, velocity, interval, turns)

    def _insert(
        self,
        frame: Frame,
        encoded: Any,
        motion: FrameMotion,
        velocity: Float[Tensor, "4 4"] | None,
        interval: float,
        turns: Sequence[Turn],
    ) -> TrackResult:
        anchor = self.keyframes[motion.keyframe]
        state = self.keyframes.add(frame.index, frame.timestamp, frame.image, encoded, motion.T_cw)
        state.pose = frame.pose
        T = motion.T_cw @ se3_inverse(anchor.T_cw)
        state.inverse_depth, state.information = grid_fields(self.grid).transfer(
            T, anchor.inverse_depth, anchor.information
        )
        if self.is_metric:
            self.sensing.join(state, frame.depth)
        self._seen_at(state, velocity=velocity, interval=interval)
        self._unfinished = Unfinished(state, anchor.id, motion, turns)
        if self._defers:
            return TrackResult(self.state, state.id)
        return self.complete()

    def complete(self) -> TrackResult:
        """Do what the new keyframe takes beyond its place: neighbours, depth, local adjustment."""
        new, self._unfinished = self._unfinished, None
        assert new is not None, "no keyframe waits to be completed"
        state, anchor = new.keyframe, self.keyframes[new.anchor]
        self.priors.ask(state)
        self.recorder.add_keyframe(state.id, new.turns)
        self._connect(state.id, anchor.id)
        seen = self.graph.edges[state.id, anchor.id]
        state.moving = carried(self.grid, anchor.moving, seen.pixels, seen.weight)
        self._adjust_locally()
        self.odometry.look()
        removed = self._cull()
        fresh = self._finalise(self.keyframes.ids[:-1])
        return TrackResult(self.state, state.id, fresh, self.active, removed)

    def follower(self) -> Follower:
        """What locates the frames that come while another thread completes the keyframe."""
        assert self._unfinished is not None, "no keyframe waits to be completed"
        assert self._last is not None
        last = replace(self._last, keyframe=self._last.keyframe.as_it_is())
        anchor = self.keyframes[self._unfinished.anchor].as_it_is()
        return Follower(
            self._locator, self.operator, self.config, last, anchor, self._unfinished.motion
        )

    def take(self, follower: Follower) -> None:
        """Take over the frames that were followed while the keyframe was completed."""
        keyframe = self.keyframes[follower.last.keyframe.id]
        for found in follower.frames:
            frame, encoded = found.frame, found.encoded
            T_rel = keyframe.at_present_scale(found.T_rel, follower.last.scale)
            self.recorder.add(frame, encoded, keyframe.id, T_rel, found.motion.match)
            self.orientation.located(frame, encoded)
            self._choice.see(frame.image)
        self._last = replace(follower.last, keyframe=keyframe)
        self._motion = None  # by which a frame was located at what the keyframe was

    def _connect(self, id: int, anchor: int) -> None:
        """Measure a new keyframe against the one it was located at, and its neighbours."""
        c, ids = self.config, self.keyframes.ids
        pairs = proximity_pairs(
            self.keyframes,
            [id],
            ids[-c.proximity_window : -1],
            self.graph.pairs,
            c.radius,
            1,
            c.proximity_distance * self._long_edge,
            c.radius + c.proximity_pairs,
        )
        # Neighbours in time are none where the camera was lost in between.
        broken = [p for p in pairs if any(p[0] < b <= p[1] for b in self._breaks)]
        there, back = frame_distances(self.keyframes, broken + [p[::-1] for p in broken]).chunk(2)
        apart = {p for p, d in zip(broken, (there + back).tolist(), strict=True) if d == torch.inf}
        pairs = [p for p in pairs if p not in apart]
        self.graph.measure({*pairs, (anchor, id)}, fine=False)

    def _adjust_locally(self) -> None:
        c, poses, depths = self.config, self.active, self.deep
        moving, deep = set(poses), set(depths)
        for n in range(c.local_rounds):
            edges = [e for e in self.graph.edges if e[0] in deep or not moving.isdisjoint(e)]
            if n:
                pairs = [e for e in edges if e[0] < e[1] and not moving.isdisjoint(e)]
                self.graph.measure(self.graph.stale(pairs, c.remeasure), fine=False)
            self.graph.adjust(
                edges, poses, depths, BundleOptions(iterations=c.local_iterations, huber=c.huber)
            )
            if n == 0:
                self.graph.judge_moving(deep, c.moving)
            if n >= c.local_rounds - self.priors.config.rounds:
                self.priors.adjust(depths, c.huber)
        self.graph.release(moving)

    def _cull(self) -> tuple[int, ...]:
        """Remove the keyframe before the last if it adds little (DROID-SLAM's keyframe test)."""
        ids = self.keyframes.ids
        if len(ids) <= MIN_KEYFRAMES or ids[-2] in self._finalized:
            return ()
        before, id = ids[-3], ids[-2]
        if stands_alone([self.keyframes[k] for k in ids[-3:]]):
            return ()
        distance = frame_distances(self.keyframes, [(before, id), (id, before)]).mean()
        if float(distance) >= self.config.cull_distance * self._long_edge:
            return ()
        self.graph.remove_keyframe(id)
        self.recorder.keyframe_removed(self.keyframes.remove(id), before)
        return (id,)

    def _finalise(self, ids: list[int]) -> tuple[int, ...]:
        fresh = [k for k in ids if k not in self._finalized]
        for id in fresh:
            if self._finalized:
                self.recorder.finalise(next(reversed(self._finalized)), id)
            self._finalized[id] = None
        return tuple(fresh)
