"""Results of a SLAM system, available at any time."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import Tensor

from geogs.config import Config
from geogs.errors import InputError
from geogs.executors.in_order import InOrder
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.guard.entrance import Entrance
from geogs.loop.closer import LoopCloser
from geogs.mapping.mapper import Mapper
from geogs.mapping.rendered import MapRenderer, RenderedView
from geogs.pose_estimate import PoseEstimate
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.tracking.frames.seen_rows import straight_rows
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
    """Reads the world without changing it."""

    config: Config
    world: World
    """State of the system."""
    segments: Segments
    loops: LoopCloser
    executor: InOrder
    stopwatch: Stopwatch
    entrance: Entrance

    def __repr__(self) -> str:
        keyframes = len(self.segments.keyframe_ids)
        counts = f"{self.frames} frames, {keyframes} keyframes, {self.executor.disks} disks"
        return f"{type(self).__name__}({counts})"

    @property
    def camera(self) -> Camera:
        """Pinhole of the map and of straight images."""
        return self.world.keyframes.camera

    def straightened(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return an image of the camera in the pinhole of the map."""
        view = self.world.keyframes.view
        return image if view is None else view.image(image)

    @property
    def frames(self) -> int:
        """Number of images so far."""
        return self.world.frames

    @property
    def will_refine(self) -> bool:
        """Whether a refinement of the map follows the final bundle adjustment."""
        return self.config.mapping.final_iterations != 0

    @property
    def metric_scale(self) -> MetricScale | None:
        """Metric scale, from a known length or a depth sensor; None if lengths are not metres.

        A part of the error of sensor depths is common to all: it is the error of the scale.
        """
        if self.world.metric_scale is not None or not self.segments.main.segment.is_metric:
            return self.world.metric_scale
        return MetricScale("depth sensor", 1.0, self.config.sensor.ratio)

    @property
    def lens(self) -> FoundLens | None:
        """Distortion that the last adjustment estimated beyond the given calibration; poses,
        keyframes and map are corrected for it."""
        return self.world.keyframes.lens

    @property
    def T_cw(self) -> Float64[Tensor, "4 4"] | None:
        """Last known pose, world to camera, in whatever segment; None before the first."""
        return self.executor.T_cw

    @on_one_torch_thread
    def settle(self) -> None:
        """Wait until the world includes all results of the last frame.

        Raises InputError in a forked process, which has none of the threads.
        """
        self.entrance.require_process()
        self.executor.settle()

    def settled(self) -> World:
        """Return the world with the results of all threads, to be packed before the next frame."""
        self.settle()
        self.segments.settle()
        self.loops.settle()
        self.executor.mapper.settle()
        return self.world

    @on_one_torch_thread
    def trajectory(self) -> Trajectory:
        """Return the poses of all frames so far."""
        self.settle()
        with self.stopwatch("trajectory"):
            return self.segments.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """Return the poses of the keyframes alone."""
        self.settle()
        keyframes = [self.world.keyframes[i] for i in self.segments.main.segment.free]
        T_wc = [torch.linalg.inv(k.T_cw).numpy() for k in keyframes]
        times = np.array([k.timestamp for k in keyframes], dtype=np.float64)
        return Trajectory(times, np.array(T_wc).reshape(-1, 4, 4), np.ones(len(times), dtype=bool))

    def uncertainty(self) -> Uncertainty | None:
        """Return the standard deviations of tracked frames, by all matches of the last adjustment.

        None before that: until then only the latest matches are kept. Empty where no map could be
        started.
        """
        if self.world.is_ended and not self.segments.keyframe_ids:
            return Uncertainty(*4 * (np.zeros(0),))
        return self.world.uncertainty

    def statistics(self) -> dict[str, object]:
        """Return statistics of segments, loops and moving objects for the summary, as JSON."""
        self.settle()
        records = self.segments.main.map.recorder.log.records
        found = sum(record.is_found for record in records)
        return {
            "refined": self.world.is_refined,
            "metric_scale": None if self.metric_scale is None else asdict(self.metric_scale),
            "poses": self._pose_agreement(),
            "lens": None if self.lens is None else asdict(self.lens),
            "moving": round(dynamic_fraction(self.segments.main.keyframes), 4),
            "segments": [asdict(segment) for segment in self.segments.summary()],
            **({"placed_afterwards": found} if found else {}),
            "not_started": self.world.segments.why_not or None,
            "loops": len(self.world.loops.loops),
            "loop_closures": self.world.loops.closures,
        }

    def _pose_agreement(self) -> dict[str, object] | None:
        """Return the agreement of odometry poses with the images; None where there are none."""
        agreement = self.segments.main.map.odometry.agreement()
        if not agreement.motions:
            return None
        return {
            "motions": agreement.motions,
            "fitting": round(agreement.fitting, 4),
            "used": agreement.used,
        }

    def rows(self) -> dict[int, SeenRows]:
        """Return the :class:`SeenRows` of rectified keyframes, by id."""
        segment = self.segments.main.segment
        known = segment.frames.rows
        view_of = segment.keyframes.table.view_of
        seen = [(k.id, known[k.frame_index]) for k in segment.keyframes if k.frame_index in known]
        views = {id: view for id, _ in seen if (view := view_of(id)) is not None}
        return {id: straight_rows(r, views[id]) if id in views else r for id, r in seen}

    # --- the map -------------------------------------------------------------------------------

    def snapshot(self) -> MapSnapshot:
        """Return the present disks."""
        return self.executor.ask(lambda mapper: mapper.table.disks.snapshot())

    @on_one_torch_thread
    def renders(self) -> Sequence[RenderedKeyframe]:
        """Render depth, normal and confidence of the present map from every mapped keyframe.

        For a long video most are read from a temporary file on access.
        """
        with self.stopwatch("rendering"):
            return self.executor.ask(Mapper.renders)

    def renderer(self) -> MapRenderer:
        """Return a renderer of the present map for any view."""
        return self.executor.ask(Mapper.renderer)

    @on_one_torch_thread
    def render(self, T_cw: GivenPose, camera: Camera | None = None) -> RenderedView:
        """Render the present map from a pose; as :meth:`MapRenderer.render`.

        Raises InputError before there is a map.
        """
        if not self.executor.disks:
            raise InputError(
                "There is no map to render yet; it begins some frames after the first, or with "
                "finish() where it is made at the end."
            )
        return self.renderer().render(T_cw, camera)

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """Return the searched depth and confidence of every mapped keyframe, without the disks.

        Each is read on access.
        """
        return self.executor.ask(Mapper.depth_maps)

    def _estimate(self, state: TrackState, timestamp: float) -> PoseEstimate:
        """Return the pose estimate right after a frame."""
        counts = self.world.frames, len(self.segments.keyframe_ids), self.executor.disks
        in_main = self.segments.current is self.segments.main and state is TrackState.TRACKING
        T_cw = self.T_cw if in_main else None
        if T_cw is None:
            return PoseEstimate(state, *counts, timestamp)
        pose = T_cw.detach().double().cpu().clone()
        deviation = self.executor.deviation()
        return PoseEstimate(state, *counts, timestamp, pose.numpy(), deviation)
