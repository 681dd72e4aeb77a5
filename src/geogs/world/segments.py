"""Tracking state of each segment of video; no motion links two segments.

Keyframes of one segment share a gauge, which is a coordinate frame and a unit of length. One of the
segments is the main map, which is shown and written. Source: the atlas of ORB-SLAM3 (Campos et al.
2021), with one map.
"""

from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.errors import InputError
from geogs.geometry.lie import se3_exp, se3_log
from geogs.limits import RIGID, UNBOUNDED, AtLeast0, Id, KeyframeId, Number, Pose, Positive
from geogs.world.arrays import NOT_STORED
from geogs.world.edges import Edge, Pair
from geogs.world.frames import FrameLog
from geogs.world.keyframes import Keyframe, KeyframeSet, KeyframeTable
from geogs.world.tables import check_tables

CONSTANT_RATE = 0.2
"""Fraction by which a frame interval may differ from the last and still count as equal: time stamps
are rounded."""
MAX_EXTRAPOLATION = 3.0
"""Largest predicted motion over the last motion, however long no frame came."""


class TrackState(Enum):
    """State of the tracking of a segment."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    TURNING = "orientation only"
    """Too little of the map is in view: the camera's position is not known."""
    LOST = "lost"


@dataclass(eq=False)
class LastFrame:
    """Pose of the last located frame relative to a keyframe, so that corrections apply to it."""

    keyframe: KeyframeId
    T_rel: Pose
    """Transform from the keyframe to this frame."""
    velocity: Pose | None
    """Motion from the frame before; None where the camera was lost there."""
    scale: Positive
    """Scale of the keyframe when ``T_rel`` and ``velocity`` were measured."""
    timestamp: float
    """Seconds."""
    interval: AtLeast0
    """Duration of the motion, seconds."""

    @staticmethod
    def at(
        keyframe: Keyframe, velocity: Float[Tensor, "4 4"] | None = None, interval: float = 0.0
    ) -> "LastFrame":
        """Return the last frame where it is a keyframe."""
        eye = torch.eye(4, dtype=torch.float64)
        return LastFrame(keyframe.id, eye, velocity, keyframe.scale, keyframe.timestamp, interval)

    def T_cw(self, keyframe: Keyframe) -> Float[Tensor, "4 4"]:
        """Return world to camera by the keyframe's present pose and scale."""
        return keyframe.at_present_scale(self.T_rel, self.scale) @ keyframe.T_cw

    def predicted(self, keyframe: Keyframe, timestamp: float) -> Float[Tensor, "4 4"]:
        """Predict world to camera of the next frame, at a time, at constant velocity."""
        if self.velocity is None:
            return self.T_cw(keyframe)
        motion = keyframe.at_present_scale(self.velocity, self.scale)
        ratio = (timestamp - self.timestamp) / self.interval if self.interval > 0 else 1.0
        if abs(ratio - 1) > CONSTANT_RATE:
            motion = se3_exp(min(max(ratio, 0.0), MAX_EXTRAPOLATION) * se3_log(motion))
        return motion @ self.T_cw(keyframe)


@dataclass(eq=False)
class ChainedPositions:
    """Positions of the cells of a first image in the latest, from which flow is continued."""

    there: Float32[Tensor, "1 p 2"] | None = None
    back: Float32[Tensor, "1 p 2"] | None = None
    """Positions of the cells of the latest image in the first."""

    def reset(self) -> None:
        """Begin again at a new first image."""
        self.there = self.back = None


@dataclass(eq=False)
class ReferenceView:
    """A frame that later ones are matched with to track the camera's orientation."""

    index: Number
    image: UInt8[np.ndarray, "h w 3"]
    R: Annotated[Float64[Tensor, "3 3"], RIGID] | None
    """Rotation from the camera located last to this one; None where no motion links them."""
    encoded: Any = field(default=None, metadata=NOT_STORED)
    """The image encoded by the flow operator; None where it has to be computed again."""


@dataclass(eq=False)
class OrientationTrack:
    """Orientation of the camera since it was last located."""

    view: ReferenceView | None = None
    flow: ChainedPositions = field(default_factory=ChainedPositions)
    """Flow from the view to the latest frame."""
    misses: Number = 0
    """Frames in a row that did not match the view."""

    def reset(self, view: ReferenceView | None = None) -> None:
        """Begin again at a view, or without one: no motion then links the next frame."""
        self.view = view
        self.misses = 0
        self.flow.reset()


@dataclass(eq=False)
class TrackStatus:
    """Tracking state of the camera after the frames so far."""

    state: TrackState = TrackState.INITIALIZING
    last: LastFrame | None = None
    orientation: OrientationTrack = field(default_factory=OrientationTrack)
    misses: Number = 0
    """Frames since the camera was last located."""
    frames_lost: Number = 0
    """Frames among them that have texture and show more than a rotation."""

    @property
    def has_map(self) -> bool:
        """Whether the segment's map has been started."""
        return self.state is not TrackState.INITIALIZING

    def lose(self) -> None:
        """Mark the camera as lost, with unknown velocity."""
        self.state = TrackState.LOST
        if self.last is not None:
            self.last.velocity = None


@dataclass(eq=False)
class StartUpProgress:
    """State of a start-up beside its keyframes and frames."""

    flow: ChainedPositions = field(default_factory=ChainedPositions)
    """Flow from the last keyframe to the latest frame."""
    misses: Number = 0
    """Frames in a row that did not match the last keyframe."""
    min_keyframes: Number = 0
    """Number of keyframes for the next attempt, where an earlier one was far off."""


@dataclass(eq=False)
class OdometryScale:
    """Scale of odometry poses given with the images."""

    scale: Positive | None = None
    """Metres to the unit of the map; None as long as the measured motions do not fit."""
    deviation: Annotated[float, UNBOUNDED, Range(0)] = float("inf")
    """Relative deviation of the scale."""


@dataclass(eq=False)
class VideoSegment:
    """Tracking data of one segment of video; mutable."""

    number: Id = 0
    """Stable, never used again."""
    keyframes: KeyframeSet = field(default_factory=KeyframeSet)
    edges: dict[Pair, Edge] = field(default_factory=dict)
    """Measured flow between keyframes, in both directions of each pair."""
    frames: FrameLog = field(default_factory=FrameLog)
    status: TrackStatus = field(default_factory=TrackStatus)
    final: list[KeyframeId] = field(default_factory=list)
    """Keyframes that will not be removed any more, earliest first."""
    fixed: list[KeyframeId] = field(default_factory=list)
    """Keyframes of a saved map, which are fixed and define the gauge of this segment."""
    breaks: list[Id] = field(default_factory=list)
    """Keyframes that no motion links to the one before them."""
    sharpness: list[float] = field(default_factory=list)
    """Sharpness of the latest frames."""
    start: StartUpProgress = field(default_factory=StartUpProgress)
    odometry: OdometryScale = field(default_factory=OdometryScale)
    is_metric: bool = False
    """Whether a depth sensor started the map; it is then in metres."""

    @property
    def ids(self) -> list[int]:
        """Ids of all keyframes, earliest first; empty until the map has been started."""
        return self.keyframes.ids if self.status.has_map else []

    @property
    def free(self) -> list[int]:
        """Ids of the keyframes that a global adjustment moves, earliest first."""
        fixed = set(self.fixed)
        return [k for k in self.ids if k not in fixed]


@dataclass(frozen=True)
class SegmentFate:
    """Summary of one segment of video."""

    first_time: float
    """Seconds."""
    last_time: float
    keyframes: int
    """Number of keyframes when it was joined, or at the end."""
    fate: Literal["world", "joined", "apart"]
    """The main map, joined to it, or never joined: then its frames count as not tracked."""


@dataclass(eq=False)
class SegmentTable:
    """All segments of a video that have not been joined to another."""

    segments: list[VideoSegment] = field(default_factory=list)
    """Earliest first."""
    main: Id = 0
    """Number of the main map's segment."""
    current: Id = 0
    """Number of the camera's present segment."""
    count: Id = 0
    """Segments so far: the number of the next one."""
    joined: list[SegmentFate] = field(default_factory=list)
    why_not: str = ""
    """Reason why no segment could be started, once the stream has ended; empty if one could."""


def check_segments(table: SegmentTable, keyframes: KeyframeTable, frames: int) -> None:
    """Check segments that were read, of at most ``frames`` frames; their keyframes are attached.

    Raises InputError if one has other keyframes or another camera, or the table is incomplete.
    """
    numbers = [segment.number for segment in table.segments]
    here = {table.main, table.current} if numbers else set[int]()
    is_unique = len({*numbers}) == len(numbers)
    if not here <= {*numbers} or any(n >= table.count for n in numbers) or not is_unique:
        raise InputError("a segment is missing, or has the number of another")
    sizes = keyframes.grid.sizes
    for segment in table.segments:
        check_tables(VideoSegment, segment, sizes, {"keyframes": segment.keyframes})
        edges = segment.edges
        indices = [record.index for record in segment.frames.records]
        if not all(i != j and (j, i) in edges for i, j in edges):
            raise InputError(f"an edge of segment {segment.number} has no way back")
        if not _ascends(indices) or indices[-1:] >= [frames]:
            raise InputError(f"the frames of segment {segment.number} are not in their order")
        if not _ascends(segment.final):
            raise InputError(f"the keyframes of segment {segment.number} are not in their order")


def _ascends(numbers: list[int]) -> bool:
    return all(a < b for a, b in pairwise(numbers))
