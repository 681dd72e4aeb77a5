"""The system on one page: track, grow and train the map, refine poses, correct globally."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from geogs.config import Config
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.loop.closer import LoopCloser
from geogs.loop.global_bundle import global_bundle
from geogs.mapping.background import BackgroundMapper
from geogs.mapping.map_all import map_all
from geogs.mapping.mapper import Mapper
from geogs.mapping.rendered import MapRenderer
from geogs.priors.base import MonocularPrior
from geogs.stopwatch import Stopwatch, StopwatchState
from geogs.threads import on_one_torch_thread
from geogs.tracking.certainty import certainty
from geogs.tracking.completion import Completion
from geogs.tracking.flow.masked import valid_pixels
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.held import add_saved_keyframes
from geogs.tracking.moving import moving_share
from geogs.tracking.pose_deviation import PoseDeviation
from geogs.tracking.segments import Segments
from geogs.tracking.tracker import TrackResult
from geogs.types import (
    Frame,
    MapSnapshot,
    MetricScale,
    RenderedKeyframe,
    SeenRows,
    Trajectory,
    Uncertainty,
)
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable, check_keyframes
from geogs.world.loops import LoopTable, check_loops
from geogs.world.map import MapTable
from geogs.world.segments import SegmentTable, TrackState, check_segment

R = TypeVar("R")

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


@dataclass(frozen=True, eq=False)
class SlamState:
    """What a checkpoint holds of a system between two frames.

    What a flow operator remembers of edges is left out; the classical has no memory.
    """

    keyframes: KeyframeTable
    segments: SegmentTable
    loops: LoopTable
    mapper: MapTable
    stopwatch: StopwatchState
    frames: int
    waiting: list[int]
    adjusted: int
    is_ended: bool
    defers_map: bool


class Slam:
    """Dense monocular SLAM: feed frames, finish, read the trajectory, the map and its depth maps.

    Poses are world to camera in units of the sequence's own scale, or in metres where frames come
    with the depth that a sensor measured. A monocular prior, where one is given, sees every
    keyframe.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        device: str = "cpu",
        prior: MonocularPrior | None = None,
        live: bool = False,
        mask: Bool[np.ndarray, "h w"] | None = None,
        black_is_masked: bool = False,
        defers_map: bool = False,
    ):
        """``mask``, of the size of the images, is true where they may show the scene: elsewhere
        nothing is matched, searched or mapped; with ``black_is_masked`` nor are pixels of an image
        that are quite black. ``live`` maps in a thread beside tracking, and completes
        keyframes in another, which frames do not wait for as long as they are found without, nor
        for the search and the closing of loops: results then depend on how fast the machine is.
        Of a system that ``defers_map`` there is no map until :meth:`refine`, which makes it of all
        keyframes at once, at their final poses; ``mapping.when`` may say otherwise."""
        self.config = config or Config()
        self.camera = camera
        self.device = device
        self.prior = prior
        self.mask, self.black_is_masked = mask, black_is_masked
        self._stream = _urgent_stream(device) if live else None
        """In which a live system tracks on a GPU until the stream ends; mapping's gives way."""
        self.stopwatch = Stopwatch()
        with torch.cuda.stream(self._stream):
            self._make_parts(live)
        self.frames = 0
        self.defers_map = defers_map and not live and self.config.mapping.may_follow
        """Whether keyframes are mapped at the end."""
        self._waiting: deque[int] = deque()
        self.adjusted = 0
        """Keyframes at the last bundle adjustment of all."""
        self.is_refined = False
        """Whether the map was trained over all keyframes at the end."""
        self._is_ended = False
        self.is_continued = False
        """Whether it goes on in the world of a saved map."""
        self._known: Uncertainty | None = None
        self._told_scale: MetricScale | None = None

    def _make_parts(self, live: bool) -> None:
        c, grid = self.config, SampleGrid(self.camera, self.device)
        self.operator = build_operator(c.tracking, grid, self.mask, self.black_is_masked)
        self.keyframes = KeyframeTable.on(grid, self.operator.encode, c.resident_keyframes)
        self.segments = Segments(
            SegmentTable(), self.keyframes, self.operator, c, self.prior, defers=live
        )
        self.completion = (
            Completion(self.segments, self._act_on, self.stopwatch, self._stream) if live else None
        )
        """Of keyframes, beside the frames of a live system."""
        self.loops = LoopCloser(self.segments, c.loop, not live, self.mask)
        self.background = BackgroundMapper(self.keyframes, self._new_mapper) if live else None
        """Maps until the stream ends, in a live system; then the mapper goes on from there."""
        self.mapper = self._new_mapper(self.keyframes)

    def _new_mapper(self, keyframes: KeyframeTable, table: MapTable | None = None) -> Mapper:
        c = self.config
        return Mapper(keyframes, c.mapping, c.seed, c.sensor, table)

    def state(self) -> SlamState:
        """What a checkpoint holds: to be written before the next frame, as it refers to all."""
        self.settle()
        self.segments.settle()
        self.loops.settle()
        self.mapper.settle()
        return SlamState(
            self.keyframes, self.segments.table, self.loops.table, self.mapper.table,
            self.stopwatch.state(), self.frames, list(self._waiting), self.adjusted, self._is_ended,
            self.defers_map,
        )  # fmt: skip

    @on_one_torch_thread
    def restore(self, state: SlamState) -> None:
        """Give a new system, made with the same camera and settings, the state of another.

        Raises:
            InputError: the state is of another camera, or incomplete.
        """
        segments = state.segments.segments
        self.keyframes.take_over(state.keyframes)
        check_keyframes(self.keyframes, [segment.keyframes for segment in segments])
        for segment in segments:
            segment.keyframes.attached(self.keyframes)
            check_segment(segment, self.keyframes.grid)
        self.segments.resume(state.segments)
        if not all(i in self.keyframes for i in (*state.waiting, *state.loops.keyframes)):
            raise InputError("a keyframe is missing")
        check_loops(state.loops)
        self.loops = LoopCloser(
            self.segments, self.config.loop, self.background is None, self.mask, state.loops
        )
        self.mapper = self._new_mapper(self.keyframes, state.mapper)
        self.stopwatch.load(state.stopwatch)
        self.frames, self._waiting = state.frames, deque(state.waiting)
        self.adjusted, self._is_ended = state.adjusted, state.is_ended
        self.defers_map = state.defers_map

    @on_one_torch_thread
    def start_from(self, disks: MapSnapshot, keyframes: Sequence[RenderedKeyframe]) -> None:
        """Before the first frame: go on in the world of a saved map, which stays where it is.

        The camera is looked for among its keyframes, which need their images; what cannot be found
        there is a segment of its own until loops join it. Trajectories are those of new frames.

        Raises:
            InputError: there is no keyframe, one has no image, or one of another camera.
        """
        if self.frames or not keyframes:
            raise InputError("A map with keyframes has to be given, and before the first frame.")
        ids = add_saved_keyframes(self.segments.main.segment, keyframes)
        self.loops.remember(ids)
        size, given = (self.camera.width, self.camera.height), zip(ids, keyframes, strict=True)
        masks = {i: _enlarged(k.mask, size) for i, k in given if k.mask is not None}
        with self.stopwatch("mapping"):
            if self.background is None:
                self.mapper.take_over(disks, masks, ids)
            else:
                take_over = partial(Mapper.take_over, disks=disks, masks=masks, ids=ids)
                self.background.begin_with(take_over, ids)
        if self._stream is not None:
            torch.cuda.synchronize()  # the stream in which frames are tracked reads all this
        self.is_continued = True

    @property
    def is_ended(self) -> bool:
        """Whether the stream has ended."""
        return self._is_ended

    @property
    def metric_scale(self) -> MetricScale | None:
        """By what lengths are metres: what :meth:`rescale` was told, or a depth sensor; else None.

        All depths of a sensor share a part of their error, which is the scale's.
        """
        if self._told_scale is not None or not self.segments.main.segment.is_metric:
            return self._told_scale
        return MetricScale("depth sensor", 1.0, self.config.sensor.ratio)

    @property
    def will_refine(self) -> bool:
        """Whether a refinement of the map follows the final bundle adjustment."""
        return self.config.mapping.final_iterations != 0

    @on_one_torch_thread
    def process(self, frame: Frame) -> SlamStatus:
        """Track one frame and, where it completes a keyframe, train the map.

        A live system returns when it knows where the frame is; the rest follows beside.
        """
        if self.background is None or self.completion is None:
            return self._process(frame)
        with self.background.giving_way(), torch.cuda.stream(self._stream):
            return self._process_live(frame, self.completion)

    @on_one_torch_thread
    def settle(self) -> None:
        """Wait for what the last keyframe brings, where a live system is still at it."""
        if self.completion is not None:
            self.completion.settle()

    @property
    def T_cw(self) -> Float64[Tensor, "4 4"] | None:
        """World to camera where the camera was last seen, in whatever segment; none before that."""
        return (self.completion or self.segments.current).T_cw

    def deviation(self) -> PoseDeviation | None:
        """How well the last frame's pose is known relative to the map around; none without one."""
        return (self.completion or self.segments.current).deviation()

    def _process_live(self, frame: Frame, completion: Completion) -> SlamStatus:
        with self.stopwatch("tracking"):
            is_found = completion.follow(frame)
        if is_found:
            self.frames += 1
            return self._status(TrackState.TRACKING)
        with self.stopwatch("waiting"):
            completion.settle()
        return self._process(frame)

    def _process(self, frame: Frame) -> SlamStatus:
        if self.is_continued and self.frames == 0:
            frame = replace(frame, follows_cut=True)
        with self.stopwatch("tracking"):
            result = self.segments.track(frame, self.loops.recognise)
        self.frames += 1
        if self.completion is not None and self.segments.current.is_unfinished:
            status = self._status(result.state)
            self.completion.begin(result)
            return status
        self._act_on(result)
        if self._stream is not None:
            self._stream.synchronize()  # others may read what it has written
        return self._status(result.state)

    def _act_on(self, result: TrackResult) -> None:
        """Close loops, correct and map, as a frame calls for it."""
        self._map(self._close_loops(result), self.config.mapping.lag)
        self._adjust_now_and_then()

    def _status(self, state: TrackState) -> SlamStatus:
        disks = len(self.mapper.table.disks) if self.background is None else self.background.disks
        return SlamStatus(state, self.frames, len(self.segments.keyframe_ids), disks)

    @on_one_torch_thread
    def end_stream(self) -> None:
        """After the last frame: map what waits. What there is then is the online result."""
        with self.stopwatch("waiting"):
            self.settle()
        self._is_ended = True
        with self.stopwatch("tracking"):
            result = self.segments.finish()
        if self.background is not None:
            with self.stopwatch("mapping"):
                self.mapper, self.background = self.background.settled(), None
            self._stream = self.completion = None
        if result.is_new_main:
            self.mapper = self._new_mapper(self.keyframes)
            self.segments.main.keyframes.take_corrections()
            self._waiting.clear()
        self._map(self._close_loops(result, is_last=True), lag=0)
        if not self.defers_map:  # else there is no online result
            self.stopwatch.end_stream()

    @on_one_torch_thread
    def finish(self, progress: Progress = _silent, correct: bool = True) -> None:
        """End the stream if need be, bundle-adjust all keyframes, move and refine the map.

        ``correct=False`` (after an interruption) keeps the online result as it stands.
        """
        if not self._is_ended:
            self.end_stream()
        if correct:
            self.adjust(progress)
            self.refine(progress)
        self.to_metres()

    @on_one_torch_thread
    def adjust(self, progress: Progress = _silent) -> None:
        """After the stream: bundle-adjust all keyframes and move the map, as the paper ends."""
        self._adjust_globally(progress)

    @on_one_torch_thread
    def refine(self, progress: Progress = _silent) -> None:
        """After that: train the map over all keyframes, if it is to be, or make it of them."""
        with self.stopwatch("final mapping"):
            if self.defers_map:
                self._map_at_once(progress)
            else:
                self.mapper.refine(lambda f: progress("map refinement", f))
        self.is_refined = self.will_refine

    @on_one_torch_thread
    def map_briefly(self, seconds: float, progress: Progress = _silent) -> None:
        """After an interruption: a map within about so many seconds where there is none yet."""
        if self.defers_map and self._waiting and not len(self.mapper.table.disks):
            with self.stopwatch("final mapping"):
                self._map_at_once(progress, seconds)

    @on_one_torch_thread
    def rescale(self, scale: MetricScale) -> None:
        """Multiply all lengths of poses, depths and map, after which they are metres."""
        self.settle()
        keyframes, factor = self.segments.main.keyframes, scale.factor
        shrunk = torch.eye(4, dtype=torch.float64)
        shrunk[:3, :3] /= factor
        keyframes.correct(keyframes.moved(shrunk))
        self._move_map()
        if self._known is not None:
            self._known = replace(self._known, position=factor * self._known.position)
        self._told_scale = scale

    @on_one_torch_thread
    def to_metres(self) -> None:
        """At the end: bring the map to metres where poses beside the images say by which factor.

        What is in metres already stays, and so does the world of a saved map.
        """
        odometry = self.segments.main.map.odometry
        if self.metric_scale is None and odometry.found.scale is not None and not self.is_continued:
            drift = (odometry.config.drift**2 + odometry.found.deviation**2) ** 0.5
            self.rescale(MetricScale("poses beside the images", odometry.found.scale, drift))
            odometry.found.scale = 1.0

    @on_one_torch_thread
    def trajectory(self) -> Trajectory:
        """Poses of all frames so far."""
        self.settle()
        with self.stopwatch("trajectory"):
            return self.segments.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """Poses of the keyframes alone."""
        self.settle()
        keyframes = [self.keyframes[i] for i in self.segments.main.segment.free]
        T_wc = [torch.linalg.inv(k.T_cw).numpy() for k in keyframes]
        times = np.array([k.timestamp for k in keyframes], dtype=np.float64)
        return Trajectory(times, np.array(T_wc).reshape(-1, 4, 4), np.ones(len(times), dtype=bool))

    def uncertainty(self) -> Uncertainty | None:
        """How well the keyframes are known, by all matches of the last adjustment.

        None before that: what is left of the matches until then are the latest alone. Where no map
        could be started there is no keyframe, and nothing is known.
        """
        if self._is_ended and not self.segments.keyframe_ids:
            return Uncertainty(*(np.zeros(0) for _ in range(4)))
        return self._known

    def particulars(self) -> dict[str, object]:
        """What a summary says of segments, loops and things that move, ready for JSON."""
        self.settle()
        return {
            "refined": self.is_refined,
            "metric_scale": None if self.metric_scale is None else asdict(self.metric_scale),
            "poses": self._pose_agreement(),
            "moving": round(moving_share(self.segments.main.keyframes), 4),
            "segments": [asdict(segment) for segment in self.segments.summary()],
            "not_started": self.segments.table.why_not or None,
            "loops": len(self.loops.detector.loops),
            "loop_closures": self.loops.table.closures,
        }

    def _pose_agreement(self) -> dict[str, object] | None:
        """How far poses beside the images fit them; none where there are none."""
        agreement = self.segments.main.map.odometry.agreement()
        if not agreement.motions:
            return None
        return {
            "motions": agreement.motions,
            "fitting": round(agreement.share, 4),
            "used": agreement.used,
        }

    def snapshot(self) -> MapSnapshot:
        """The disks as they are now."""
        return self._ask(lambda mapper: mapper.table.disks.snapshot())

    @on_one_torch_thread
    def renders(self) -> Sequence[RenderedKeyframe]:
        """Depth, normal and reliability of the map as it is now, seen from every mapped keyframe.

        Of a long video most are read from a temporary file when they are asked for.
        """
        with self.stopwatch("rendering"):
            return self._ask(Mapper.renders)

    def renderer(self) -> MapRenderer:
        """What shows the map as it is now from anywhere."""
        return self._ask(Mapper.renderer)

    def rows(self) -> dict[int, SeenRows]:
        """Of keyframes, by id, whose rows were rectified: where and when they were seen."""
        segment = self.segments.main.segment
        known, keyframes = segment.frames.rows, segment.keyframes
        return {k.id: known[k.frame_index] for k in keyframes if k.frame_index in known}

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """Depth and confidence of every mapped keyframe as searched, without the disks.

        Each is read when it is asked for, as it is at that time.
        """
        return self._ask(Mapper.depth_maps)

    def _ask(self, question: Callable[[Mapper], R]) -> R:
        """An answer from the mapper; while it works in its thread, from there."""
        return question(self.mapper) if self.background is None else self.background.ask(question)

    def _close_loops(self, result: TrackResult, is_last: bool = False) -> TrackResult:
        """Act on loops that a frame closed; what is to be mapped then."""
        with self.stopwatch("loops"):
            became_final = self.loops.update(result, is_last)
        self._move_map()
        return replace(result, finalized=(*result.finalized, *became_final))

    def _adjust_now_and_then(self) -> None:
        every, count = self.config.loop.global_ba_every, len(self.segments.keyframe_ids)
        if every and count - self.adjusted >= every:
            self._adjust_globally(_silent)

    def _adjust_globally(self, progress: Progress) -> None:
        """Bundle-adjust all keyframes and let the map follow."""
        world = self.segments.main
        if not world.segment.ids:
            return
        with self.stopwatch("global bundle adjustment"):
            global_bundle(world, lambda f, _: progress("bundle adjustment", f))
        if self._is_ended:
            with self.stopwatch("uncertainty"):
                self._known = certainty(world).calibrated(world)
        with self.stopwatch("global bundle adjustment"):
            self.loops.replaced_by_bundle()
        self.adjusted = len(world.segment.ids)
        self._move_map()

    def _move_map(self) -> None:
        """Let the map follow the corrections of the world's keyframes."""
        for correction in self.segments.main.keyframes.take_corrections():
            with self.stopwatch("map update"):
                (self.background or self.mapper).correct(correction)

    def _map(self, result: TrackResult, lag: int) -> None:
        """Hand settled keyframes to the mapper; train those whose successors are known."""
        self._waiting.extend(result.finalized)
        if self.defers_map:
            return
        mapper = self.background or self.mapper
        with self.stopwatch("mapping"):
            for id in result.finalized:
                mapper.observe(id, self._mask_of(id))
            trained = False
            while len(self._waiting) > lag:
                mapper.map_keyframe(self._waiting.popleft())
                trained = True
        if trained and self.background is None and self._is_pose_step_due():
            with self.stopwatch("pose refinement"):
                self.mapper.refine_poses(result.active)

    def _map_at_once(self, progress: Progress, seconds: float | None = None) -> None:
        """Hand all keyframes that wait to the mapper, and make the map of them."""
        for id in self._waiting:
            if id not in self.mapper.views:  # else it was interrupted after that
                self.mapper.observe(id, self._mask_of(id))
        map_all(self.mapper, [*self._waiting], lambda f: progress("mapping", f), seconds)
        self._waiting.clear()

    def _is_pose_step_due(self) -> bool:
        mapping = self.config.mapping
        return (
            mapping.pose_iterations > 0 and len(self.mapper.table.mapped) % mapping.pose_every == 0
        )

    def _mask_of(self, id: int) -> Bool[np.ndarray, "h w"] | None:
        """What a keyframe shows of the scene; none where that is all of its image."""
        if not self.black_is_masked:
            return self.mask
        valid = valid_pixels(self.keyframes[id].image)
        if self.mask is not None:
            valid &= self.mask
        return None if valid.all() else valid


def _urgent_stream(device: str) -> "torch.cuda.Stream | None":
    """A stream of a GPU whose work goes before that of others; none on a CPU."""
    where = torch.device(device)
    return torch.cuda.Stream(where, priority=-1) if where.type == "cuda" else None


def _enlarged(mask: Tensor, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """A mask at the size of the images, width and height."""
    small = mask.cpu().numpy().astype(np.uint8)
    return cv2.resize(small, size, interpolation=cv2.INTER_NEAREST) > 0
