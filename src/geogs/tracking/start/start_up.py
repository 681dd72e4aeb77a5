"""Start-up: gather keyframes until a map can be started from them."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch

from geogs.config import TrackingConfig
from geogs.geometry.lie import retract, se3_inverse, se3_log, so3_log
from geogs.tracking.frames.rotation_averaging import orientations
from geogs.tracking.graph.rigid_parts import largest_part
from geogs.tracking.keyframes.keyframe_choice import KeyframeChoice
from geogs.tracking.keyframes.segment_map import SegmentMap
from geogs.tracking.locate.frame_locator import MIN_KNOWN
from geogs.tracking.locate.orientation_follower import MAX_MISSES
from geogs.tracking.matching.flow_chain import MIN_MATCHED, ChainedFlows, follow_flow
from geogs.tracking.matching.two_view_rotation import two_view_rotation
from geogs.tracking.start.initialise import (
    LAST_DEVIATION,
    MAX_DEVIATION,
    Attempt,
    initialise,
    polished,
)
from geogs.types import FlowMatch, Frame
from geogs.world.frames import FrameLog, RelativeRotation
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet
from geogs.world.segments import TrackState

MIN_KEYFRAMES = 4
MIN_OVERLAP = 0.3
"""Fraction of the first keyframe that the last still has to see for the first to be kept, while the
map cannot be started."""
MORE = 0.25
"""Fraction of additional keyframes before a start that was far off is tried again."""
MAX_DISAGREEMENT = 0.05
"""Largest difference, in radians, of a frame's orientation from the interpolated one."""


class StartUp:
    """Chooses keyframes by the flow since the last, and starts the map when there are enough."""

    def __init__(self, map: SegmentMap, choice: KeyframeChoice, config: TrackingConfig) -> None:
        self.map = map
        self.config = config
        self._choice = choice
        self.keyframes = map.keyframes
        self._grid = SampleGrid(map.keyframes.grid.camera)
        """Grid on the CPU, where rotations are measured."""
        self._flows = ChainedFlows(map.keyframes, map.operator)
        self._progress = map.segment.start
        self._hardly_moved = False
        """Whether the images moved too little for the keyframes that a start needs."""

    def take(self, frame: Frame, encoded: Any, rotations: Sequence[RelativeRotation] = ()) -> None:
        """Process the next frame, whose rotations relative to others may be known already.

        The segment's state shows whether the map has been started.
        """
        if frame.depth is not None and self._start_metric(frame, encoded, rotations):
            return
        if not len(self.keyframes):
            self._gather(frame, encoded, rotations)
            return
        last = list(self.keyframes)[-1]
        motion = follow_flow(
            self.keyframes.grid, self.map.operator, self._progress.flow, last.encoded, encoded
        )
        if motion.overlap < MIN_MATCHED:
            self._miss(frame, encoded, rotations)
            return
        self._progress.misses = 0
        measure = partial(_rotation, last.frame_index, self._grid, motion.match.on_cpu())
        if self._choice.calls_for(motion):
            self._gather(frame, encoded, rotations, measure)
            return
        eye = torch.eye(4, dtype=torch.float64)
        self.map.recorder.add(frame, encoded, last.id, eye, motion.match, rotations)
        self.map.recorder.measure_rotation(measure)

    def finish(self) -> bool:
        """Try to start with the present frames; return whether it succeeded."""
        self._hardly_moved = 0 < len(self.keyframes) < MIN_KEYFRAMES
        if self._hardly_moved:
            self._choose_among_all()
        return self._start(LAST_DEVIATION)

    def _start(self, most_open: float) -> bool:
        """Try to start with the present keyframes, with depth deviations up to ``most_open``."""
        if len(self.keyframes) < MIN_KEYFRAMES:
            return False
        flows = self._flows.measure()
        attempt = initialise(self.map.graph, self.config, flows, most_open)
        if attempt is Attempt.APART:
            attempt = self._start_with_part(most_open)
        if attempt is Attempt.FAR_OFF:
            self._progress.min_keyframes = math.ceil((1 + MORE) * len(self.keyframes))
        if attempt is not Attempt.STARTED:
            return False
        self._flows.forget()
        self.map.priors.adjust(self.keyframes.ids)
        place_between_keyframes(self.map.recorder.log, self.keyframes)
        self.map.segment.status.state = TrackState.TRACKING
        return True

    def why_not(self) -> str:
        """Return a message for the user on why no map could be started."""
        if self._hardly_moved:
            return (
                "The camera hardly moves (no parallax), so nothing can be reconstructed; "
                "record a longer video in which the camera changes its place."
            )
        if not len(self.keyframes):
            return "No frame has enough texture to be tracked; check exposure and focus."
        return (
            "The images show no parallax (the camera only turns, or the scene is too far away); "
            "move the camera sideways while recording."
        )

    def _choose_among_all(self) -> None:
        """Make keyframes of frames that are evenly spaced in time."""
        self._forget(self.keyframes.ids)
        frames = self.map.recorder.unplaced()
        last = len(frames) - 1
        count = min(len(frames), self.config.init_keyframes)
        for n in range(count if count >= MIN_KEYFRAMES else 0):
            eye = torch.eye(4, dtype=torch.float64)
            self.map.restore(frames[n * last // (count - 1)], None, eye)

    def _start_with_part(self, most_open: float) -> Attempt:
        """Try to start with the largest rigidly connected part, dropping the other keyframes."""
        graph = self.map.graph
        keyframes = self.keyframes
        part = largest_part(keyframes, graph.edges)
        if len(part) < MIN_KEYFRAMES:
            return Attempt.FAILED
        self.map.forget([k for k in keyframes.ids if k not in part])
        for keyframe in keyframes:
            keyframe.moving = None  # judged with poses of the dropped keyframes
        return polished(graph, self.config, most_open)

    def _start_metric(
        self, frame: Frame, encoded: Any, rotations: Sequence[RelativeRotation]
    ) -> bool:
        """Start the map at once from sensor depth; False where there is too little."""
        earlier = self.keyframes.ids
        keyframe = self.map.add(frame, encoded)
        has_depth = self.map.add_sensor_depth(keyframe, frame.depth)
        if not has_depth or float(keyframe.has_known_depth.float().mean()) < MIN_KNOWN:
            self.keyframes.remove(keyframe.id)
            return False
        self._forget(earlier)
        self.map.complete(keyframe, rotations)
        self.map.segment.is_metric = True
        self.map.segment.status.state = TrackState.TRACKING
        return True

    def _gather(
        self,
        frame: Frame,
        encoded: Any,
        rotations: Sequence[RelativeRotation],
        measure: Callable[[], RelativeRotation | None] | None = None,
    ) -> None:
        """Add a keyframe for the start, and try to start when there are enough."""
        keyframe = self.map.add(frame, encoded)
        self._progress.flow.reset()
        self.map.complete(keyframe, rotations)
        if measure is not None:
            self.map.recorder.measure_rotation(measure)
        count = len(self.keyframes)
        wanted = self.config.init_keyframes
        if count < max(wanted, MIN_KEYFRAMES):
            return
        if count >= self._progress.min_keyframes:
            has_started = self._start(MAX_DEVIATION)
            if has_started or len(self.keyframes) < count:
                return
        # More keyframes may bring parallax. With twice as many every other one is removed; where
        # the last no longer overlaps with the first, the first half is dropped.
        if count < 2 * wanted:
            return
        overlap = float((self._flows.measure()[-1].weight > 0).float().mean())
        if overlap >= MIN_OVERLAP:
            self._thin_out()
            return
        has_started = self._start(LAST_DEVIATION)
        if not has_started and len(self.keyframes) == count:
            self._forget(self.keyframes.ids[: count // 2])

    def _miss(self, frame: Frame, encoded: Any, rotations: Sequence[RelativeRotation]) -> None:
        """Handle a sudden change of view: wait for its return, try to start, or begin anew."""
        self._progress.misses += 1
        is_waiting = self._progress.misses < MAX_MISSES
        if not is_waiting:
            self._progress.misses = 0
        if is_waiting or self.finish():
            self.map.recorder.add_untracked(frame.index, frame.timestamp, rotations)
            return
        self._forget(self.keyframes.ids)
        self._gather(frame, encoded, rotations)

    def _thin_out(self) -> None:
        """Make every other keyframe an ordinary frame; the first and the last stay."""
        ids = self.keyframes.ids
        self._progress.min_keyframes = 0
        for before, id in zip(ids[:-1:2], ids[1:-1:2], strict=False):
            self.map.cull(id, before)

    def _forget(self, ids: Sequence[int]) -> None:
        """Drop the earliest keyframes of a start that failed."""
        self._progress.flow.reset()
        self._progress.min_keyframes = 0
        self.map.forget(ids)


def _rotation(earlier: int, grid: SampleGrid, match: FlowMatch) -> RelativeRotation | None:
    """Estimate the rotation of a frame relative to an earlier one by the flow; all on the CPU."""
    found = two_view_rotation(grid, match)
    return None if found is None else RelativeRotation(earlier, found.R, found.deviation)


def place_between_keyframes(log: FrameLog, keyframes: KeyframeSet) -> None:
    """Interpolate poses of the frames of a start between their keyframes.

    A frame whose relative rotations contradict its pose loses it: the camera then faced away from
    both keyframes.
    """
    ordered = list(keyframes)
    oriented = orientations(
        {r.index: r.rotations for r in log.records},
        {k.frame_index: k.T_cw[:3, :3] for k in ordered},
    )
    for record in log.records:
        if record.anchor is None or record.anchor not in keyframes:
            continue
        n = keyframes.ids.index(record.anchor)
        a = ordered[n]
        b = ordered[min(n + 1, len(ordered) - 1)]
        span = max(b.frame_index - a.frame_index, 1)
        fraction = (record.index - a.frame_index) / span
        xi = se3_log(b.T_cw @ se3_inverse(a.T_cw))
        record.T_rel = retract(fraction * xi, torch.eye(4).to(xi))
        record.scale = a.scale
        R = oriented.get(record.index)
        if R is not None:
            angle = so3_log(R @ (record.T_rel @ a.T_cw)[:3, :3].mT).norm()
            if float(angle) > MAX_DISAGREEMENT:
                record.anchor = None
