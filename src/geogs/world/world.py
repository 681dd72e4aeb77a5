"""The world: the whole state of a SLAM system as one tree of plain data, stored in checkpoints."""

from dataclasses import dataclass, field

from geogs.errors import InputError
from geogs.limits import KeyframeId, Number
from geogs.stopwatch import StageSeconds
from geogs.types import MetricScale, Uncertainty
from geogs.world.keyframes import KeyframeTable, check_keyframes
from geogs.world.loops import LoopTable, check_loops
from geogs.world.map import MapTable
from geogs.world.segments import SegmentTable, check_segments


@dataclass(eq=False)
class World:
    """State of all stages, each of which updates it."""

    keyframes: KeyframeTable = field(default_factory=KeyframeTable)
    """Poses, depths and images of all keyframes."""
    segments: SegmentTable = field(default_factory=SegmentTable)
    """Tracking data of each segment of video: edges, frames, state."""
    loops: LoopTable = field(default_factory=LoopTable)
    map: MapTable | None = None
    """Disks and dense depths."""
    times: StageSeconds = field(default_factory=StageSeconds)
    frames: Number = 0
    """Number of images so far."""
    timestamp: float | None = None
    """Seconds of the last frame; None before the first."""
    unmapped: list[KeyframeId] = field(default_factory=list)
    """Final keyframes that are not in the map yet, earliest first."""
    adjusted: Number = 0
    """Number of keyframes at the last global bundle adjustment."""
    is_ended: bool = False
    """Whether the stream has ended."""
    maps_at_end: bool = False
    """Whether all keyframes are mapped at once, after the stream."""
    is_refined: bool = False
    """Whether the map was trained over all keyframes at the end."""
    uncertainty: Uncertainty | None = None
    """Standard deviations of frames, by the global adjustment after the stream."""
    metric_scale: MetricScale | None = None
    """Factor by which lengths were converted to metres."""


def check_world(world: World) -> None:
    """Check tables that were read against each other and the camera of the attached grid.

    Raises InputError if something is missing or of another camera.
    """
    keyframes = world.keyframes
    segments = world.segments.segments
    for segment in segments:
        segment.keyframes.attached(keyframes)
    check_keyframes(keyframes, [segment.keyframes for segment in segments])
    check_segments(world.segments, keyframes, world.frames)
    check_loops(world.loops, keyframes, {segment.number for segment in segments})
    mapped = [] if world.map is None else world.map.mapped
    if not all(i in keyframes for i in (*world.unmapped, *mapped)):
        raise InputError("a keyframe is missing")
    done = {*mapped} if world.maps_at_end else set()
    waiting = [i for i in world.unmapped if i not in done]
    final = {i for segment in segments for i in segment.final}
    known = [*mapped, *waiting]
    if not final.issuperset(known) or len(set(known)) < len(known):
        raise InputError("a keyframe is mapped twice, or while it may still be removed")
