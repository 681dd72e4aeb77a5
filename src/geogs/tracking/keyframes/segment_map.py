"""Keyframes of a segment with their edges, priors, sensor depth and log."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import Config
from geogs.priors.monocular_prior import MonocularPrior
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.frames.frame_recorder import FrameRecorder
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.graph.measured_odometry import Odometry
from geogs.tracking.keyframes.keyframe_depth_sensor import KeyframeDepthSensor
from geogs.tracking.keyframes.monocular_priors import KeyframePriors
from geogs.types import Frame
from geogs.world.frames import FrameRecord, RelativeRotation
from geogs.world.keyframes import Keyframe
from geogs.world.segments import VideoSegment


class SegmentMap:
    """Adds keyframes to a segment and removes them, keeping all their data consistent."""

    def __init__(
        self,
        segment: VideoSegment,
        operator: FlowOperator,
        config: Config,
        prior: MonocularPrior | None = None,
    ) -> None:
        self.segment = segment
        self.keyframes = keyframes = segment.keyframes
        self.odometry = Odometry(keyframes, config.odometry, segment.odometry)
        self.graph = FrameGraph(keyframes, operator, self.odometry, segment.edges)
        self.recorder = FrameRecorder(segment.frames, keyframes, operator)
        self.priors = KeyframePriors(self.graph, prior, config.prior)
        self.sensor = KeyframeDepthSensor(keyframes.grid, config.sensor)

    @property
    def operator(self) -> FlowOperator:
        """Flow operator."""
        return self.graph.operator

    def add(self, frame: Frame, encoded: Any, T_cw: Float[Tensor, "4 4"] | None = None) -> Keyframe:
        """Make a frame a keyframe at a pose (default: identity); depths are unknown."""
        T_cw = torch.eye(4, dtype=torch.float64) if T_cw is None else T_cw
        keyframe = self.keyframes.add(frame.index, frame.timestamp, frame.image, encoded, T_cw)
        keyframe.pose = frame.pose
        return keyframe

    def complete(self, keyframe: Keyframe, rotations: Sequence[RelativeRotation]) -> None:
        """Predict the prior of a new keyframe, and log its frame."""
        self.priors.ask(keyframe)
        self.recorder.add_keyframe(keyframe, rotations)

    def cull(self, id: int, substitute: int) -> None:
        """Make a keyframe an ordinary frame; those anchored to it move to a substitute."""
        self.graph.remove_keyframe(id)
        self.recorder.keyframe_removed(self.keyframes.remove(id), substitute)

    def forget(self, ids: Sequence[int]) -> None:
        """Drop keyframes; their frames then have no pose."""
        for id in ids:
            self.graph.remove_keyframe(id)
            self.recorder.keyframe_forgotten(self.keyframes.remove(id))

    def restore(self, record: FrameRecord, id: int | None, T_cw: Float[Tensor, "4 4"]) -> Keyframe:
        """Make a waiting frame a keyframe: again with its former ``id``, or as the latest."""
        assert record.image is not None, "a frame that does not wait has no image"
        encoded = self.recorder.encoded(record)
        keyframe = self.keyframes.add(
            record.index, record.timestamp, record.image, encoded, T_cw, id
        )
        self.priors.ask(keyframe)
        self.recorder.keyframe_restored(record, keyframe)
        return keyframe

    def finalise(self, ids: Sequence[int]) -> tuple[int, ...]:
        """Make keyframes final; return those that were not final before."""
        final = self.segment.final
        known = set(final)
        fresh = tuple(k for k in ids if k not in known)
        for id in fresh:
            if final:
                self.recorder.finalise(final[-1], id)
            final.append(id)
        return fresh

    def absorb(self, other: "SegmentMap") -> None:
        """Take over the keyframes and frames of another map, already in this one's gauge."""
        self.keyframes.absorb(other.keyframes)
        self.graph.replace(dict(sorted({**self.graph.edges, **other.graph.edges}.items())))
        self.recorder.absorb(other.recorder)
