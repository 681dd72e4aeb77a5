"""Before there is a map: gather keyframes until one can be started from them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from geogs.config import TrackingConfig
from geogs.tracking.chained_flows import ChainedFlows
from geogs.tracking.graph import FrameGraph
from geogs.tracking.initialise import Attempt, initialise
from geogs.tracking.keyframe_choice import KeyframeChoice
from geogs.tracking.keyframe_priors import KeyframePriors
from geogs.tracking.motion import ChainState, FlowChain
from geogs.tracking.rotation import relative_rotation
from geogs.tracking.trajectory import TrajectoryRecorder
from geogs.tracking.turns import Turn
from geogs.types import FlowMatch, Frame
from geogs.world.grid import SampleGrid

MIN_KEYFRAMES = 4
MAX_MISSES = 5
"""Frames without a match after which a start that has not succeeded begins anew."""
MORE = 0.25
"""Part of the keyframes that are to come before a start is tried again that was far off."""


@dataclass(frozen=True)
class StartStep:
    """What one frame changed."""

    has_started: bool = False
    """Whether all keyframes now have poses and depths."""
    is_keyframe: bool = False
    removed: tuple[int, ...] = ()
    """Ids of keyframes that were given up."""


@dataclass(frozen=True, eq=False)
class StartUpState:
    """What a checkpoint holds of a start, beside keyframes and frames."""

    misses: int
    enough: int
    chain: ChainState


class StartUp:
    """Chooses keyframes by the flow since the last, and starts the map once there are enough."""

    def __init__(
        self,
        graph: FrameGraph,
        recorder: TrajectoryRecorder,
        priors: KeyframePriors,
        config: TrackingConfig,
        choice: KeyframeChoice,
    ) -> None:
        self.graph, self.recorder, self.priors, self.config = graph, recorder, priors, config
        self.keyframes = graph.keyframes
        self._choice = choice
        self._grid = SampleGrid(self.keyframes.grid.camera)
        """On the CPU, where turns are measured."""
        self._chain = FlowChain(self.keyframes.grid, graph.operator, config.min_ncc)
        self._flows = ChainedFlows(graph)
        self._misses = 0
        self._enough = 0
        """Keyframes with which a start is tried, where an earlier one was far off."""

    def state(self) -> StartUpState:
        """What a checkpoint holds."""
        return StartUpState(self._misses, self._enough, self._chain.state())

    def load(self, state: StartUpState) -> None:
        """Go on where another was."""
        self._misses, self._enough = state.misses, state.enough
        self._chain.load(state.chain)

    def take(self, frame: Frame, encoded: Any, turns: Sequence[Turn] = ()) -> StartStep:
        """Take the next frame, of which turns against others may be known already."""
        if len(self.keyframes):
            last = list(self.keyframes)[-1]
            match = self._chain.follow(last.encoded, encoded)
            if match.matched < self.config.min_matched:
                return self._miss(frame, encoded, turns)
            self._misses = 0
            there = FlowMatch(match.there.pixels.cpu(), match.there.weight.cpu())
            measure = partial(_turn, last.frame_index, self._grid, there)
            if self._choice.calls_for(match.flow, match.matched):
                return self._gather(frame, encoded, turns, measure)
            eye = torch.eye(4, dtype=torch.float64)
            self.recorder.add(frame, encoded, last.id, eye, match.there, turns)
            self.recorder.turned(measure)
            return StartStep()
        return self._gather(frame, encoded, turns)

    def finish(self) -> bool:
        """Start with what there is; False if that cannot be."""
        if len(self.keyframes) < MIN_KEYFRAMES:
            return False
        attempt = initialise(self.graph, self.config, self._flows.measure())
        if attempt is Attempt.FAR_OFF:
            self._enough = math.ceil((1 + MORE) * len(self.keyframes))
        if attempt is not Attempt.STARTED:
            return False
        self._flows.forget()
        self.priors.adjust(self.keyframes.ids, self.config.huber)
        self.recorder.anchor_to_keyframes()
        return True

    def why_not(self) -> str:
        """What to tell somebody whose video could not be started with."""
        if not len(self.keyframes):
            return "No frame has enough texture to be tracked; check exposure and focus."
        if len(self.keyframes) < MIN_KEYFRAMES:
            return (
                "The camera hardly moves (no parallax), so nothing can be reconstructed; "
                "record a longer video in which the camera changes its place."
            )
        return (
            "The images show no parallax (the camera only turns, or the scene is too far away); "
            "move the camera sideways while recording."
        )

    def _gather(
        self,
        frame: Frame,
        encoded: Any,
        turns: Sequence[Turn],
        measure: Callable[[], Turn | None] | None = None,
    ) -> StartStep:
        """Add a keyframe to those the map will be started from, and start it with enough."""
        eye = torch.eye(4, dtype=torch.float64)
        state = self.keyframes.add(frame.index, frame.timestamp, frame.image, encoded, eye)
        state.pose = frame.pose
        self.priors.ask(state)
        self._chain.reset()
        self.recorder.add_keyframe(state.id, turns)
        if measure is not None:
            self.recorder.turned(measure)
        if len(self.keyframes) < max(self.config.init_keyframes, MIN_KEYFRAMES):
            return StartStep(is_keyframe=True)
        if len(self.keyframes) >= self._enough and self.finish():
            return StartStep(True, True)
        # More keyframes may bring parallax. With twice as many every other one is left out; where
        # the last no longer sees what the first saw, the first half is given up.
        if len(self.keyframes) < 2 * self.config.init_keyframes:
            return StartStep(False, True)
        overlap = float((self._flows.measure()[-1].weight > 0).float().mean())
        if overlap >= self.config.start_overlap:
            return StartStep(False, True, self._thin_out())
        return StartStep(False, True, self._forget(len(self.keyframes) // 2))

    def _miss(self, frame: Frame, encoded: Any, turns: Sequence[Turn]) -> StartStep:
        """The view changed at once: wait for it to come back, start with what there is, or anew."""
        self._misses += 1
        if self._misses < MAX_MISSES:
            self.recorder.add_untracked(frame.index, frame.timestamp, turns)
            return StartStep()
        self._misses = 0
        if self.finish():
            self.recorder.add_untracked(frame.index, frame.timestamp, turns)
            return StartStep(True)
        removed = self._forget(len(self.keyframes))
        step = self._gather(frame, encoded, turns)
        return StartStep(step.has_started, step.is_keyframe, removed)

    def give_up(self, ids: Sequence[int]) -> tuple[int, ...]:
        """Drop the keyframes gathered so far, since the map is started without them."""
        self._chain.reset()
        return self._forget(len(ids))

    def _thin_out(self) -> tuple[int, ...]:
        """Make every other keyframe an ordinary frame; the first and the last stay."""
        ids = self.keyframes.ids
        gone = tuple(ids[1:-1:2])
        self._enough = 0
        for id in gone:
            self.graph.remove_keyframe(id)
            self.recorder.keyframe_removed(self.keyframes.remove(id), ids[ids.index(id) - 1])
        return gone

    def _forget(self, count: int) -> tuple[int, ...]:
        """Drop the earliest keyframes of a start that failed."""
        gone = tuple(self.keyframes.ids[:count])
        self._enough = 0
        for id in gone:
            self.graph.remove_keyframe(id)
            self.recorder.keyframe_forgotten(self.keyframes.remove(id))
        return gone


def _turn(earlier: int, grid: SampleGrid, match: FlowMatch) -> Turn | None:
    """How a frame is turned against an earlier one, by the flow from there; all on the CPU."""
    found = relative_rotation(grid, match)
    return None if found is None else Turn(earlier, found.R, found.deviation)
