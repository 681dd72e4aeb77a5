"""What can be asked of a SLAM system at any time."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.config import Config
from geogs.errors import InputError
from geogs.executors.in_order import InOrder
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.loop.closer import LoopCloser
from geogs.mapping.mapper import Mapper
from geogs.mapping.rendered import MapRenderer, RenderedView
from geogs.pose_estimate import PoseEstimate
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.tracking.frames.straight_rows import straight_rows
from geogs.tracking.graph.dynamic_cells import dynamic_fraction
from geogs.tracking.segment_trackers import Segments
from geogs.types import (
    FoundLens,
    MapSnapshot,
    MetricScale,
    RenderedKeyframe,
    SeenRows,
    Trajectory,
    Uncertainty,
)
from geogs.world.segments import TrackState
from geogs.world.world import World


class SlamOutput:
    """Reads the world; changes nothing of it."""

    config: Config
    world: World
    """All that is known."""
    segments: Segments
    loops: LoopCloser
    executor: InOrder
    stopwatch: Stopwatch

    @property
    def camera(self) -> Camera:
        """Pinhole of all images."""
        return self.world.keyframes.camera

    @property
    def frames(self) -> int:
        """Images so far."""
        return self.world.frames

    @property
    def will_refine(self) -> bool:
        """Whether a refinement of the map follows the final bundle adjustment."""
        return self.config.mapping.final_iterations != 0

    @property
    def metric_scale(self) -> MetricScale | None:
        """What makes lengths metres: a known length, or a depth sensor; None where they are not.

        All depths of a sensor share a part of their error, which is the scale's.
        """
        if self.world.metric_scale is not None or not self.segments.main.segment.is_metric:
            return self.world.metric_scale
        return MetricScale("depth sensor", 1.0, self.config.sensor.ratio)

    @property
    def lens(self) -> FoundLens | None:
        """What the last adjustment found that images bend beside what was said of the lens; poses,
        keyframes and map are without it."""
        return self.world.keyframes.lens

    @property
    def T_cw(self) -> Float64[Tensor, "4 4"] | None:
        """World to camera where the camera was last seen, in whatever segment; none before that."""
        return self.executor.T_cw

    @on_one_torch_thread
    def settle(self) -> None:
        """Wait until the world holds all that the last frame brings."""
        self.executor.settle()

    def settled(self) -> World:
        """The world with all that threads have found, to be packed before the next frame."""
        self.settle()
        self.segments.settle()
        self.loops.settle()
        self.executor.mapper.settle()
        return self.world

    @on_one_torch_thread
    def trajectory(self) -> Trajectory:
        """Poses of all frames so far."""
        self.settle()
        with self.stopwatch("trajectory"):
            return self.segments.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """Poses of the keyframes alone."""
        self.settle()
        keyframes = [self.world.keyframes[i] for i in self.segments.main.segment.free]
        T_wc = [torch.linalg.inv(k.T_cw).numpy() for k in keyframes]
        times = np.array([k.timestamp for k in keyframes], dtype=np.float64)
        return Trajectory(times, np.array(T_wc).reshape(-1, 4, 4), np.ones(len(times), dtype=bool))

    def uncertainty(self) -> Uncertainty | None:
        """How well the tracked frames are known, by all matches of the last adjustment.

        None before that: what is left of the matches until then are the latest alone. Where no map
        could be started there is no keyframe, and nothing is known.
        """
        if self.world.is_ended and not self.segments.keyframe_ids:
            return Uncertainty(*4 * (np.zeros(0),))
        return self.world.uncertainty

    def statistics(self) -> dict[str, object]:
        """What a summary says of segments, loops and things that move, ready for JSON."""
        self.settle()
        return {
            "refined": self.world.is_refined,
            "metric_scale": None if self.metric_scale is None else asdict(self.metric_scale),
            "poses": self._pose_agreement(),
            "lens": None if self.lens is None else asdict(self.lens),
            "moving": round(dynamic_fraction(self.segments.main.keyframes), 4),
            "segments": [asdict(segment) for segment in self.segments.summary()],
            **self._placed_afterwards(),
            "not_started": self.world.segments.why_not or None,
            "loops": len(self.world.loops.loops),
            "loop_closures": self.world.loops.closures,
        }

    def _placed_afterwards(self) -> dict[str, object]:
        """How many frames were lost and placed after the stream; nothing where none was."""
        records = self.segments.main.map.recorder.log.records
        found = sum(record.is_found for record in records)
        return {"placed_afterwards": found} if found else {}

    def _pose_agreement(self) -> dict[str, object] | None:
        """How far poses beside the images fit them; none where there are none."""
        agreement = self.segments.main.map.odometry.agreement()
        if not agreement.motions:
            return None
        return {
            "motions": agreement.motions,
            "fitting": round(agreement.fitting, 4),
            "used": agreement.used,
        }

    def rows(self) -> dict[int, SeenRows]:
        """When and where the rows of keyframes, by id, were seen, for those that were rectified."""
        segment = self.segments.main.segment
        known, view_of = segment.frames.rows, segment.keyframes.table.view_of
        seen = [(k.id, known[k.frame_index]) for k in segment.keyframes if k.frame_index in known]
        views = {id: view for id, _ in seen if (view := view_of(id)) is not None}
        return {id: straight_rows(r, views[id]) if id in views else r for id, r in seen}

    # --- the map -------------------------------------------------------------------------------

    def snapshot(self) -> MapSnapshot:
        """The disks as they are now."""
        return self.executor.ask(lambda mapper: mapper.table.disks.snapshot())

    @on_one_torch_thread
    def renders(self) -> Sequence[RenderedKeyframe]:
        """Depth, normal and reliability of the map as it is now, seen from every mapped keyframe.

        Of a long video most are read from a temporary file when they are asked for.
        """
        with self.stopwatch("rendering"):
            return self.executor.ask(Mapper.renders)

    def renderer(self) -> MapRenderer:
        """What shows the map as it is now from anywhere."""
        return self.executor.ask(Mapper.renderer)

    @on_one_torch_thread
    def render(self, T_cw: GivenPose, camera: Camera | None = None) -> RenderedView:
        """The map as it is now, seen from a pose; as :meth:`MapRenderer.render`.

        Raises InputError before there is a map.
        """
        if not self.executor.disks:
            raise InputError(
                "There is no map to render yet; it begins some frames after the first, or with "
                "finish() where it is made at the end."
            )
        return self.renderer().render(T_cw, camera)

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """Depth and confidence of every mapped keyframe as searched, without the disks.

        Each is read when it is asked for, as it is at that time.
        """
        return self.executor.ask(Mapper.depth_maps)

    def _estimate(self, state: TrackState, timestamp: float) -> PoseEstimate:
        """What is known right after a frame."""
        counts = self.world.frames, len(self.segments.keyframe_ids), self.executor.disks
        in_main = self.segments.current is self.segments.main and state is TrackState.TRACKING
        T_cw = self.T_cw if in_main else None
        if T_cw is None:
            return PoseEstimate(state, *counts, timestamp)
        pose, deviation = T_cw.detach().double().cpu().clone(), self.executor.deviation()
        return PoseEstimate(state, *counts, timestamp, pose.numpy(), deviation)
