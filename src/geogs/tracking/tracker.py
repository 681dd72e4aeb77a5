"""The front end: frames in, keyframes with poses and inverse depth out."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import PriorConfig, TrackingConfig
from geogs.errors import GeogsError, InputError, TrackingLost
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.priors.base import MonocularPrior
from geogs.tracking.bundle import BundleOptions
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.flow.select import build_operator
from geogs.tracking.graph import FrameGraph, frame_distances, proximity_pairs
from geogs.tracking.grid import SampleGrid
from geogs.tracking.initialise import initialise
from geogs.tracking.keyframe_priors import KeyframePriors
from geogs.tracking.keyframes import KeyframeState, KeyframeStore
from geogs.tracking.motion import FlowChain, FrameLocator, FrameMotion, transfer_depth
from geogs.tracking.trajectory import TrajectoryRecorder
from geogs.types import Frame, Keyframe, PoseCorrection, Trajectory

MIN_KEYFRAMES = 4
MAX_MISSES = 5
"""Frames without a match after which a start that has not succeeded begins anew."""


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
    ) -> None:
        cv2.setRNGSeed(seed)
        self.camera = camera
        self.config = config or TrackingConfig()
        self.grid = SampleGrid(camera, device)
        self.operator = operator or build_operator(self.config, self.grid)
        self.store = KeyframeStore(self.grid, self.operator.encode, self.config.resident_keyframes)
        self.graph = FrameGraph(self.store, self.operator)
        self.priors = KeyframePriors(self.graph, prior, prior_config or PriorConfig())
        self.recorder = TrajectoryRecorder(self.store, self.operator)
        self.state = TrackState.INITIALIZING
        edge = max(camera.width, camera.height)
        self._long_edge = edge
        self._locator = FrameLocator(
            self.grid, self.operator, self.config.min_matched, self.config.max_residual * edge
        )
        self._finalized: list[int] = []
        self._last: tuple[int, Tensor] | None = None
        """Pose of the last frame: a keyframe and the motion from it, so that corrections carry."""
        self._velocity: Tensor | None = None
        self._chain = FlowChain(self.grid, self.operator)
        self._misses = 0

    # --- reading ---------------------------------------------------------------------------

    @property
    def keyframe_ids(self) -> list[int]:
        """Ids of all keyframes, earliest first; empty until the map has been started."""
        return [] if self.state is TrackState.INITIALIZING else self.store.ids

    def keyframe(self, id: int) -> Keyframe:
        """Present state of a keyframe."""
        return self.store.export(id)

    def trajectory(self) -> Trajectory:
        """Poses of all frames seen so far, solved on the present keyframes.

        Before the map is started nothing counts as tracked.
        """
        trajectory = self.recorder.solve()
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
        """Take over poses and scales of a loop closure or another global correction."""
        for id, T in correction.after.items():
            state, scale = self.store[id], correction.scale.get(id, 1.0)
            state.T_cw = T.to(state.T_cw)
            state.inverse_depth = state.inverse_depth * scale
            state.information = state.information / scale**2
            if state.prior is not None:
                state.prior.rescale(1 / scale)

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
            return self._lose(frame)
        return self._follow(frame, encoded, motion)

    def finish(self) -> TrackResult:
        """End of the stream: every keyframe becomes final.

        Raises TrackingLost if the map could never be started.
        """
        if self.state is TrackState.INITIALIZING and not (
            len(self.store) >= MIN_KEYFRAMES and self._initialise()
        ):
            raise TrackingLost(self._why_not_started())
        fresh = self._finalise(self.store.ids)
        self.recorder.finalise(self.store.ids[-1], None)
        return TrackResult(self.state, None, fresh, ())

    def _why_not_started(self) -> str:
        if not len(self.store):
            return "No frame has enough texture to be tracked; check exposure and focus."
        if len(self.store) < MIN_KEYFRAMES:
            return (
                "The camera hardly moves (no parallax), so nothing can be reconstructed; "
                "record a longer video in which the camera changes its place."
            )
        return (
            "The images show no parallax (the camera only turns, or the scene is too far away); "
            "move the camera sideways while recording."
        )

    # --- before the map is started ---------------------------------------------------------

    def _start(self, frame: Frame, encoded: Any) -> TrackResult:
        if len(self.store):
            last = list(self.store)[-1]
            match = self._chain.follow(last.encoded, encoded)
            if match.matched < self.config.min_matched:
                return self._restart(frame, encoded)
            self._misses = 0
            if match.flow < self.config.keyframe_flow * self._long_edge:
                eye = torch.eye(4, dtype=torch.float64)
                self.recorder.add(frame.index, frame.timestamp, encoded, last.id, eye, match.there)
                return TrackResult(self.state)
        return self._gather(frame, encoded)

    def _gather(self, frame: Frame, encoded: Any) -> TrackResult:
        """Add a keyframe to those the map will be started from, and start it with enough."""
        eye = torch.eye(4, dtype=torch.float64)
        state = self.store.add(frame.index, frame.timestamp, frame.image, encoded, eye)
        self.priors.ask(state)
        self._chain.reset()
        self.recorder.add_keyframe(state.id)
        if len(self.store) < max(self.config.init_keyframes, MIN_KEYFRAMES):
            return TrackResult(self.state)
        if not self._initialise():
            # More keyframes may bring parallax; with twice as many the first are given up.
            full = len(self.store) >= 2 * self.config.init_keyframes
            return TrackResult(self.state, removed=self._forget(len(self.store) // 2 * full))
        fresh = self._finalise(self.store.ids[:-1])
        return TrackResult(self.state, state.id, fresh, self.active)

    def _restart(self, frame: Frame, encoded: Any) -> TrackResult:
        """The view changed at once: wait for it to come back, start with what there is, or anew."""
        self._misses += 1
        if self._misses < MAX_MISSES:
            self.recorder.add_untracked(frame.index, frame.timestamp)
            return TrackResult(self.state)
        self._misses = 0
        if len(self.store) >= MIN_KEYFRAMES and self._initialise():
            self.recorder.add_untracked(frame.index, frame.timestamp)
            return TrackResult(self.state, None, self._finalise(self.store.ids[:-1]), self.active)
        removed = self._forget(len(self.store))
        return replace(self._gather(frame, encoded), removed=removed)

    def _initialise(self) -> bool:
        ok = initialise(self.graph, self.config.min_parallax * self._long_edge, self.config.radius)
        if ok:
            self.priors.adjust(self.store.ids, self.config.huber)
            self.state = TrackState.TRACKING
            self._last = (self.store.ids[-1], torch.eye(4).to(list(self.store)[-1].T_cw))
            self.recorder.anchor_to_keyframes()
        return ok

    def _forget(self, count: int) -> tuple[int, ...]:
        """Drop the earliest keyframes of a start that failed."""
        gone = tuple(self.store.ids[:count])
        for id in gone:
            self.graph.remove_keyframe(id)
            self.store.remove(id)
        return gone

    # --- with a map ------------------------------------------------------------------------

    def _locate(self, encoded: Any) -> FrameMotion | None:
        states = list(self.store)
        last = states[-1]
        motion = None
        before = self._last_pose()
        if before is not None and self.state is TrackState.TRACKING:
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
        self.state, self._misses = TrackState.TRACKING, 0
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
        self._connect(state.id)
        self._adjust_locally()
        removed = self._cull()
        self._last = (state.id, torch.eye(4).to(state.T_cw))
        fresh = self._finalise(self.store.ids[:-1])
        return TrackResult(self.state, state.id, fresh, self.active, removed)

    def _connect(self, id: int) -> None:
        """Measure a new keyframe against its neighbours."""
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
        self.graph.measure(pairs, fine=False)

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
                self.recorder.finalise(self._finalized[-1], id)
            self._finalized.append(id)
        return tuple(fresh)
