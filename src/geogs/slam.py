"""The system on one page: track, grow and train the map, refine poses, correct globally."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.loop.global_bundle import global_bundle
from geogs.mapping.mapper import Mapper
from geogs.priors.base import MonocularPrior
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.tracking.tracker import Tracker, TrackResult, TrackState
from geogs.types import Frame, MapSnapshot, RenderedKeyframe, Trajectory

Progress = Callable[[str, float], None]
"""Called with the name of a stage and its finished fraction in [0, 1]."""


def _silent(stage: str, fraction: float) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class SlamStatus:
    """What there is to say after a frame."""

    state: TrackState
    frames: int
    keyframes: int
    disks: int


class Slam:
    """Dense monocular SLAM: feed frames, finish, read the trajectory, the map and its depth maps.

    Poses are world to camera in units of the sequence's own scale; nothing here is metric. A
    monocular prior, where one is given, sees every keyframe.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        device: str = "cpu",
        prior: MonocularPrior | None = None,
    ):
        self.config = config or Config()
        self.camera = camera
        c = self.config
        self.tracker = Tracker(
            camera, c.tracking, device, c.seed, prior=prior, prior_config=c.prior
        )
        self.mapper = Mapper(camera, self.config.mapping, device, self.config.seed)
        self.stopwatch = Stopwatch()
        self.frames = 0
        self._waiting: deque[int] = deque()
        self._is_ended = False

    @on_one_torch_thread
    def process(self, frame: Frame) -> SlamStatus:
        """Track one frame and, where it completes a keyframe, train the map."""
        with self.stopwatch("tracking"):
            result = self.tracker.track(frame)
        self.frames += 1
        self._map(result, self.config.mapping.lag)
        return SlamStatus(
            result.state, self.frames, len(self.tracker.keyframe_ids), len(self.mapper.map)
        )

    @on_one_torch_thread
    def end_stream(self) -> None:
        """After the last frame: map what waits. What there is then is the online result."""
        self._is_ended = True
        with self.stopwatch("tracking"):
            result = self.tracker.finish()
        self._map(result, lag=0)

    @on_one_torch_thread
    def finish(self, progress: Progress = _silent, correct: bool = True) -> None:
        """End the stream if need be, bundle-adjust all keyframes, move and refine the map.

        ``correct=False`` (after an interruption) keeps the online result as it stands.
        """
        if not self._is_ended:
            self.end_stream()
        if not correct:
            return
        with self.stopwatch("global bundle adjustment"):
            correction = global_bundle(self.tracker, lambda f, _: progress("bundle adjustment", f))
        with self.stopwatch("map update"):
            self.mapper.correct(correction, self._keyframes(self.mapper.keyframe_ids))
        with self.stopwatch("final mapping"):
            self.mapper.refine(lambda f: progress("map refinement", f))

    @on_one_torch_thread
    def trajectory(self) -> Trajectory:
        """Poses of all frames so far."""
        with self.stopwatch("trajectory"):
            return self.tracker.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """Poses of the keyframes alone."""
        keyframes = self._keyframes(self.tracker.keyframe_ids)
        T_wc = [torch.linalg.inv(k.T_cw.cpu()).numpy() for k in keyframes]
        times = np.array([k.timestamp for k in keyframes], dtype=np.float64)
        return Trajectory(times, np.array(T_wc).reshape(-1, 4, 4), np.ones(len(times), dtype=bool))

    def snapshot(self) -> MapSnapshot:
        """The disks as they are now."""
        return self.mapper.map.snapshot()

    @on_one_torch_thread
    def renders(self) -> list[RenderedKeyframe]:
        """Depth, normal and reliability of the map seen from every mapped keyframe."""
        with self.stopwatch("rendering"):
            return self.mapper.renders()

    @on_one_torch_thread
    def depth_maps(self) -> list[RenderedKeyframe]:
        """Depth and confidence of every mapped keyframe as searched, without the disks."""
        return self.mapper.depth_maps()

    def _map(self, result: TrackResult, lag: int) -> None:
        """Hand settled keyframes to the mapper; train those whose successors are known."""
        self._waiting.extend(result.finalized)
        with self.stopwatch("mapping"):
            for keyframe in self._keyframes(list(result.finalized)):
                self.mapper.observe(keyframe)
            if result.new_keyframe is not None or result.removed or result.finalized:
                self.mapper.follow(self._keyframes(list(result.active)))
            trained = False
            while len(self._waiting) > lag:
                self.mapper.map_keyframe(self._waiting.popleft())
                trained = True
        if trained and self.config.mapping.pose_iterations:
            with self.stopwatch("pose refinement"):
                self.tracker.write_back(self.mapper.refine_poses(list(result.active)))

    def _keyframes(self, ids: list[int]) -> list:
        alive = set(self.tracker.keyframe_ids)
        return [self.tracker.keyframe(i) for i in ids if i in alive]
