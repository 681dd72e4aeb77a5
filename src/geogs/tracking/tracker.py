"""The front end: frames in, keyframes with poses and inverse depth out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.base import BundleOptions
from geogs.config import PriorConfig, TrackingConfig
from geogs.errors import GeogsError, InputError, TrackingLost
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.store import KeyframeIds, KeyframeState, KeyframeStore, scaled
from geogs.priors.base import MonocularPrior
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.flow.select import build_operator
from geogs.tracking.graph import FrameGraph
from geogs.tracking.keyframe_priors import KeyframePriors
from geogs.tracking.motion import (
    FrameLocator,
    FrameMotion,
    Recognition,
    transfer_depth,
)
from geogs.tracking.proximity import frame_distances, proximity_pairs
from geogs.tracking.start_up import MIN_KEYFRAMES, StartUp
from geogs.tracking.trajectory import FrameRecord, TrajectoryRecorder
from geogs.types import Frame, Keyframe, PoseCorrection, Trajectory


class TrackState(Enum):
    """What the tracker is doing."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
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
        ids: KeyframeIds | None = None,
    ) -> None:
        cv2.setRNGSeed(seed)
        self.camera = camera
        self.config = config or TrackingConfig()
        self.grid = SampleGrid(camera, device)
        self.operator = operator or build_operator(self.config, self.grid)
        self.store = KeyframeStore(
            self.grid, self.operator.encode, self.config.resident_keyframes, ids
        )
        self.graph = FrameGraph(self.store, self.operator)
        self.priors = KeyframePriors(self.graph, prior, prior_config or PriorConfig())
        self.recorder = TrajectoryRecorder(self.store, self.operator)
        self.state = TrackState.INITIALIZING
        edge = max(camera.width, camera.height)
        self._long_edge = edge
        self._locator = FrameLocator(
            self.grid, self.operator, self.config.min_matched, self.config.max_residual * edge
        )
        self._finalized: dict[int, None] = {}
        self._breaks: list[int] = []
        """Keyframes that no motion links to the one before them."""
        self._last: tuple[int, Tensor] | None = None
        """Pose of the last frame: a keyframe and the motion from it, so that corrections carry."""
        self._velocity: Tensor | None = None
        self._start_up = StartUp(self.graph, self.recorder, self.priors, self.config)
        self._misses = 0
        self.frames_lost = 0
        """Frames with texture since the camera was last located, once the map has been started."""

    # --- reading ---------------------------------------------------------------------------

    @property
    def keyframe_ids(self) -> list[int]:
        """Ids of all keyframes, earliest first; empty until the map has been started."""
        return [] if self.state is TrackState.INITIALIZING else self.store.ids

    def keyframe(self, id: int) -> Keyframe:
        """Present state of a keyframe."""
        return self.store.export(id)

    @property
    def finalized(self) -> tuple[int, ...]:
        """Ids that are never removed any more, earliest first."""
        return tuple(self._finalized)

    def trajectory(self, apart: Sequence[FrameRecord] = ()) -> Trajectory:
        """Poses of all frames seen so far, solved on the present keyframes.

        Before the map is started nothing counts as tracked, and frames ``apart`` never do.
        """
        trajectory = self.recorder.solve(apart)
        if self.state is TrackState.INITIALIZING:
            return replace(trajectory, tracked=np.zeros_like(trajectory.tracked))
        return trajectory

    @property
    def active(self) -> tuple[int, ...]:
        """Ids whose poses the local adjustment moves, earliest first; never the very first."""
        ids = self.keyframe_ids
        return tuple(k for k in ids[-self.config.window :] if k != ids[0])

    # --- writing ---------------------------------------------------------------------------

    def write_back(self, poses: Mapping[int, Float[Tensor, "4 4"]]) -> None:
        """Take over poses (world to camera) that were refined elsewhere.

        Raises GeogsError for a keyframe that is not active.
        """
        unknown = set(poses) - set(self.active)
        if unknown:
            raise GeogsError(f"Poses of keyframes {sorted(unknown)} are no longer free.")
        for id, T in poses.items():
            self.store[id].T_cw = T.to(self.store[id].T_cw)

    def correct(self, correction: PoseCorrection) -> None:
        """Take over poses and scales of a loop closure or another global correction.

        What is known relative to a keyframe, such as where the last frame was, moves along.
        """
        for id, T in correction.after.items():
            self.store[id].T_cw = T.to(self.store[id].T_cw)
            self.store[id].rescale(1 / correction.scale.get(id, 1.0))
        self.recorder.rescale(correction.scale)
        if self._last is not None:
            scale = 1 / correction.scale.get(self._last[0], 1.0)
            self._last = (self._last[0], scaled(self._last[1], scale))
            if self._velocity is not None:
                self._velocity = scaled(self._velocity, scale)

    def absorb(self, other: "Tracker") -> None:
        """Take over the keyframes and frames of another tracker, already in this one's world.

        The camera is where the later of the two saw it last. The other is of no more use.
        """
        if other.store.ids[0] > self.store.ids[0]:
            self._breaks.append(other.store.ids[0])
        after = [k for k in self.store.ids if k > other.store.ids[-1]]
        self._breaks = sorted({*self._breaks, *other._breaks, *after[:1]})
        if other.store.ids[-1] > self.store.ids[-1]:
            self.state, self._misses = other.state, other._misses
            self._last, self._velocity = other._last, other._velocity
            self.frames_lost = other.frames_lost
        self._finalized = dict.fromkeys(sorted([*self._finalized, *other._finalized]))
        self.store.absorb(other.store)
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
        encoded = self.operator.encode(frame.image)
        if self.operator.texture(encoded) < self.config.min_texture:
            return self._lose(frame)
        if self.state is TrackState.INITIALIZING:
            return self._start(frame, encoded)
        motion = self._locate(encoded)
        if motion is None:
            self.frames_lost += 1
            return self._lose(frame)
        return self._follow(frame, encoded, motion)

    def rejoin(self, frame: Frame, places: Sequence[Recognition]) -> TrackResult | None:
        """Take the next frame, which was recognised at one of some keyframes; None if it was not.

        A place is believed where the dense flow agrees with it over ``recognised`` of the cells.
        """
        encoded = self.operator.encode(frame.image)
        for place in places:
            if place.keyframe not in self.store:
                continue
            keyframe = self.store[place.keyframe]
            guess = place.T_rel.to(keyframe.T_cw) @ keyframe.T_cw
            motion = self._locator.locate(keyframe, encoded, guess)
            if motion is not None and motion.matched >= self.config.recognised:
                self.cut()
                return self._follow(frame, encoded, motion)
        return None

    def cut(self) -> None:
        """No motion links the next frame to those before it; the camera has to be found anew."""
        if self.state is not TrackState.INITIALIZING:
            self.state, self._velocity = TrackState.LOST, None

    def finish(self) -> TrackResult:
        """End of the stream: every keyframe becomes final.

        Raises TrackingLost if the map could never be started.
        """
        if self.state is TrackState.INITIALIZING:
            if not self._start_up.finish():
                raise TrackingLost(self._start_up.why_not())
            self._begin()
        fresh = self._finalise(self.store.ids)
        self.recorder.finalise(self.store.ids[-1], None)
        return TrackResult(self.state, None, fresh, ())

    def _start(self, frame: Frame, encoded: Any) -> TrackResult:
        step = self._start_up.take(frame, encoded)
        if not step.has_started:
            return TrackResult(self.state, removed=step.removed)
        self._begin()
        newest = self.store.ids[-1] if step.is_keyframe else None
        fresh = self._finalise(self.store.ids[:-1])
        return TrackResult(self.state, newest, fresh, self.active, step.removed)

    def _begin(self) -> None:
        self.state = TrackState.TRACKING
        self._last = (self.store.ids[-1], torch.eye(4, dtype=torch.float64))

    # --- with a map ------------------------------------------------------------------------

    def _locate(self, encoded: Any) -> FrameMotion | None:
        motion = None
        before = self._last_pose()
        if self._last is not None and before is not None and self.state is TrackState.TRACKING:
            last = self.store[self._last[0]]
            guess = before if self._velocity is None else self._velocity @ before
            motion = self._locator.locate(last, encoded, guess)
            if motion is None and self._velocity is not None:
                motion = self._locator.locate(last, encoded, before)
        if motion is None:
            motion = self._locator.relocate_any(self._places(), encoded)
        return motion

    def _last_pose(self) -> Float[Tensor, "4 4"] | None:
        return None if self._last is None else self._last[1] @ self.store[self._last[0]].T_cw

    def _places(self) -> list[KeyframeState]:
        """Where to look for a lost camera: recent keyframes, and older ones in turn."""
        count, states = self.config.relocalise, list(self.store)
        recent, older = states[: -count - 1 : -1], states[:-count]
        turn = (self._misses * count) % max(len(older), 1)
        return recent + (older[turn:] + older[:turn])[:count]

    def _lose(self, frame: Frame) -> TrackResult:
        if self.state is not TrackState.INITIALIZING:
            self.state = TrackState.LOST
            self._velocity = None
            self._misses += 1
        self.recorder.add_untracked(frame.index, frame.timestamp)
        return TrackResult(self.state, active=self.active)

    def _follow(self, frame: Frame, encoded: Any, motion: FrameMotion) -> TrackResult:
        before = self._last_pose() if self.state is TrackState.TRACKING else None
        self._velocity = None if before is None else motion.T_cw @ se3_inverse(before)
        if self.state is TrackState.LOST:
            self._breaks.append(self.store.next_id)
        self.state, self._misses, self.frames_lost = TrackState.TRACKING, 0, 0
        anchor = self.store[motion.keyframe]
        T_rel = motion.T_cw @ se3_inverse(anchor.T_cw)
        self._last = (anchor.id, T_rel)
        if motion.flow < self.config.keyframe_flow * self._long_edge:
            self.recorder.add(frame.index, frame.timestamp, encoded, anchor.id, T_rel, motion.match)
            return TrackResult(self.state, active=self.active)
        return self._insert(frame, encoded, motion)

    def _insert(self, frame: Frame, encoded: Any, motion: FrameMotion) -> TrackResult:
        anchor = self.store[motion.keyframe]
        state = self.store.add(frame.index, frame.timestamp, frame.image, encoded, motion.T_cw)
        self.priors.ask(state)
        T = motion.T_cw @ se3_inverse(anchor.T_cw)
        state.inverse_depth, state.information = transfer_depth(
            self.grid, T, anchor.inverse_depth, anchor.information
        )
        self.recorder.add_keyframe(state.id)
        self._connect(state.id, anchor.id)
        self._adjust_locally()
        removed = self._cull()
        self._last = (state.id, torch.eye(4).to(state.T_cw))
        fresh = self._finalise(self.store.ids[:-1])
        return TrackResult(self.state, state.id, fresh, self.active, removed)

    def _connect(self, id: int, anchor: int) -> None:
        """Measure a new keyframe against the one it was located at, and its neighbours."""
        c, ids = self.config, self.store.ids
        pairs = proximity_pairs(
            self.store,
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
        there, back = frame_distances(self.store, broken + [p[::-1] for p in broken]).chunk(2)
        apart = {p for p, d in zip(broken, (there + back).tolist(), strict=True) if d == torch.inf}
        pairs = [p for p in pairs if p not in apart]
        self.graph.measure({*pairs, (anchor, id)}, fine=False)

    def _adjust_locally(self) -> None:
        c, ids = self.config, self.store.ids
        poses = [k for k in ids[-c.window :] if k != ids[0]]
        depths = ids[-max(c.window, c.depth_window) :]
        moving, deep = set(poses), set(depths)
        for n in range(c.local_rounds):
            edges = [e for e in self.graph.edges if e[0] in deep or not moving.isdisjoint(e)]
            if n:
                pairs = [e for e in edges if e[0] < e[1] and not moving.isdisjoint(e)]
                self.graph.measure(self.graph.stale(pairs, c.remeasure), fine=False)
            self.graph.adjust(
                edges, poses, depths, BundleOptions(iterations=c.local_iterations, huber=c.huber)
            )
            if n >= c.local_rounds - self.priors.config.rounds:
                self.priors.adjust(depths, c.huber)
        self.graph.release(moving)

    def _cull(self) -> tuple[int, ...]:
        """Remove the keyframe before the last if it adds little (DROID-SLAM's keyframe test)."""
        ids = self.store.ids
        if len(ids) <= MIN_KEYFRAMES or ids[-2] in self._finalized:
            return ()
        before, id = ids[-3], ids[-2]
        distance = frame_distances(self.store, [(before, id), (id, before)]).mean()
        if float(distance) >= self.config.cull_distance * self._long_edge:
            return ()
        self.graph.remove_keyframe(id)
        self.recorder.keyframe_removed(self.store.remove(id), before)
        return (id,)

    def _finalise(self, ids: list[int]) -> tuple[int, ...]:
        fresh = [k for k in ids if k not in self._finalized]
        for id in fresh:
            if self._finalized:
                self.recorder.finalise(next(reversed(self._finalized)), id)
            self._finalized[id] = None
        return tuple(fresh)
