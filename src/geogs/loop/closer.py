"""Loop closing during tracking: loops are found at final keyframes, and closed if they matter."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.config import LoopConfig
from geogs.geometry.lie import se3_inverse, sim3_inverse, sim3_scale
from geogs.loop.closure import (
    ClosingQuestion,
    LoopClosure,
    brought_forward,
    close_loops,
    take_over_depths,
)
from geogs.loop.constraints import (
    AGREEING_LOOPS,
    JOIN_TOLERANCE,
    between_positions,
    closing_matches,
    differences,
    disagreement,
    joined,
    of_edges,
    of_loop,
    of_poses,
    rescaled,
    squared_errors,
    thinned,
)
from geogs.loop.detect import LoopDetector
from geogs.loop.settled import settled_pairs
from geogs.tracking.locate.frame_locator import Recognition
from geogs.tracking.segment_trackers import Segments
from geogs.tracking.tracker import Tracker, TrackResult
from geogs.types import PoseCorrection
from geogs.world.edges import Pair
from geogs.world.loops import Loop, LoopTable, RelativePoses, SegmentConstraints

MOST_LOOPS = 200
"""Number of loop poses above which older ones are thinned out: bounds the pose graph."""
RETIRED_TOGETHER = 64
"""Directed edges, of some eight keyframes, converted to relative poses at a time."""


@dataclass(frozen=True)
class _Asked:
    """A closing computed by a thread."""

    question: ClosingQuestion
    answer: Future[LoopClosure | None]
    world: Tracker
    age: int
    """Age of the main map when it was submitted."""


class LoopCloser:
    """Closes loops in the main map of a run, and joins segments that meet."""

    def __init__(
        self,
        segments: Segments,
        config: LoopConfig,
        waits: bool = True,
        mask: Bool[np.ndarray, "h w"] | None = None,
        table: LoopTable | None = None,
    ) -> None:
        """``waits`` and ``mask`` as in :class:`LoopDetector`. Without waiting, closings are also
        computed by a thread, and take effect at a later final keyframe."""
        self.segments = segments
        self.config = config
        tracker = segments.main
        self.table = table or LoopTable()
        self.detector = LoopDetector(
            tracker.keyframes.table, tracker.map.operator, config, waits, mask, self.table
        )
        self._thread = None if waits else ThreadPoolExecutor(1, thread_name_prefix="closing")
        self._asked: _Asked | None = None
        """Closing that the thread computes, or has computed."""
        self._age = 0
        """Number of changes of the main map other than closings."""

    def settle(self) -> None:
        """Bring the table up to date: wait for running searches."""
        self.detector.settle()

    def remember(self, ids: Sequence[int]) -> None:
        """Add keyframes of a saved map to place recognition, without loops among them."""
        if self.config.enabled:
            self.detector.remember(ids)

    def recognise(self, image: UInt8[np.ndarray, "h w 3"]) -> Sequence[Recognition]:
        """Return keyframes recognised in an image."""
        return self.detector.recognise(image) if self.config.enabled else ()

    def update(self, result: TrackResult, is_last: bool = False) -> tuple[int, ...]:
        """Search loops at the keyframes that became final with a frame, and close them.

        Returns the ids of final keyframes that were joined to the main map. Corrections are taken
        from its keyframes (``KeyframeSet.take_corrections``).
        """
        if not self.config.enabled:
            return ()
        fresh = [*result.finalized, *result.finalized_elsewhere]
        if fresh:
            self._retire(self.segments.tracker_of(fresh[0]), RETIRED_TOGETHER)
        settled = self._settled(fresh) if fresh or is_last else []
        for loop in self.detector.update(fresh, is_last, settled):
            self._take(loop)
        # Between keyframes nothing changes that could join segments.
        became_final = self._join() if fresh or is_last else ()
        if self._asked is not None and (is_last or (fresh and self._asked.answer.done())):
            self._take_answer()
        if self._thread is None or fresh or is_last:
            self._close(is_last)
        return became_final

    def replaced_by_bundle(self) -> None:
        """Replace the main map's relative poses by its edges, after a global bundle adjustment."""
        self._age += 1
        world = self.segments.main
        order = {k: n for n, k in enumerate(world.keyframes.ids)}
        edges = {
            e: v
            for e, v in world.map.graph.edges.items()
            if order[e[1]] - order[e[0]] not in (2, 3)
        }
        fixed = of_poses(world.keyframes, sorted(world.segment.fixed))
        self.table.constraints[world.segment.number] = SegmentConstraints(
            joined([fixed, of_edges(world.keyframes, edges)])
        )
        self._retire(world)

    def _settled(self, fresh: Sequence[int]) -> list[Pair]:
        """Return pairs near which newly final keyframes need no search."""
        tracker = self.segments.tracker_of(fresh[0]) if fresh else self.segments.main
        known = self._of(tracker)
        edges = tracker.map.graph.edges
        relative = joined([known.odometry, known.loops])
        min_gap = self.config.min_gap
        min_change = self.config.min_change
        return settled_pairs(tracker.keyframes, relative, edges, min_gap, min_change)

    def _of(self, tracker: Tracker) -> SegmentConstraints:
        """Return the relative poses of a segment."""
        known = self.table.constraints
        number = tracker.segment.number
        if number not in known:
            fixed = sorted(tracker.segment.fixed)
            known[number] = SegmentConstraints(of_poses(tracker.keyframes, fixed))
        return known[number]

    def _retire(self, tracker: Tracker, least: int = 1) -> None:
        """Convert edges that have left the local adjustment to relative poses.

        Nothing changes with fewer than ``least`` of them.
        """
        old = tracker.map.graph.retire(tracker.local.deep, least)
        if old:
            known = self._of(tracker)
            known.odometry = joined([known.odometry, of_edges(tracker.keyframes, old)])

    def _take(self, loop: Loop) -> None:
        first, second = (self.segments.tracker_of(k) for k in (loop.first, loop.second))
        if first is not second:
            self.table.between.append(loop)
            return
        known = self._of(first)
        constraint = self._constraint(loop)
        if not len(constraint):
            return
        known.loops = thinned(joined([known.loops, constraint]), MOST_LOOPS)
        differs = differences(first.keyframes, constraint) >= self.config.min_change
        errors = squared_errors(first.keyframes, constraint)
        known.pending += bool((differs & (errors > self.config.residual)).any())

    def _constraint(self, loop: Loop) -> RelativePoses:
        return of_loop(self.segments.main.keyframes.table, loop)

    # --- joining segments ------------------------------------------------------------------

    def _join(self) -> tuple[int, ...]:
        """Join segments between which enough loops agree; return ids added to the main map."""
        final: tuple[int, ...] = ()
        for loop in list(self.table.between):
            host, guest = self._ends(loop)
            S = self._claim(loop)
            agreeing = [
                o
                for o in self.table.between
                if self._ends(o) == (host, guest) and self._agrees(o, S)
            ]
            if len(agreeing) < AGREEING_LOOPS:
                continue
            for o in agreeing:
                self._of(host).loops = joined([self._of(host).loops, self._constraint(o)])
            final += self._merge(host, guest, S)
            return final + self._join()
        return final

    def _ends(self, loop: Loop) -> tuple[Tracker, Tracker]:
        """Return host and guest: the main map is host, else the earlier segment."""
        a, b = (self.segments.tracker_of(k) for k in (loop.first, loop.second))
        world = self.segments.main
        is_earlier = b.keyframes.ids < a.keyframes.ids
        if b is world or (a is not world and is_earlier):
            return b, a
        return a, b

    def _claim(self, loop: Loop) -> Float[Tensor, "4 4"]:
        """Return the Sim(3) from the host's world to the guest's by a loop."""
        host, guest = self._ends(loop)
        S = loop.S_ji.cpu()
        if host.segment.is_metric and guest.segment.is_metric:
            S = S.clone()
            S[:3, :3] /= sim3_scale(S)
        here, there = loop.first, loop.second
        if loop.first in guest.keyframes:
            S = sim3_inverse(S)
            here = loop.second
            there = loop.first
        return se3_inverse(guest.keyframes[there].T_cw) @ S @ host.keyframes[here].T_cw

    def _agrees(self, loop: Loop, S: Float[Tensor, "4 4"]) -> bool:
        """Whether a loop agrees with a Sim(3) between the segments."""
        _, guest = self._ends(loop)
        state = guest.keyframes[loop.second if loop.second in guest.keyframes else loop.first]
        depth = 1 / state.inverse_depth.median().cpu().double()
        error = disagreement(state.T_cw @ self._claim(loop), state.T_cw @ S, depth)
        return float(error) < JOIN_TOLERANCE

    def _merge(self, host: Tracker, guest: Tracker, S: Float[Tensor, "4 4"]) -> tuple[int, ...]:
        self._age += 1
        self._retire(guest)
        known = self.table.constraints
        theirs = known.pop(guest.segment.number, SegmentConstraints())
        ours = self._of(host)
        # The loops between the two were measured in the guest's unit, too.
        correction = guest.keyframes.moved(S)
        _rescale(theirs, correction)
        both = correction.scale | dict.fromkeys(host.keyframes.ids, 1.0)
        ours.loops = joined([rescaled(ours.loops, both), theirs.loops])
        ours.odometry = joined([ours.odometry, theirs.odometry])
        ours.pending += 1
        final = self.segments.join(host, guest, S)
        self.table.between = [
            o
            for o in self.table.between
            if self.segments.tracker_of(o.first) is not self.segments.tracker_of(o.second)
        ]
        return final if host is self.segments.main else ()

    # --- closing loops ---------------------------------------------------------------------

    def _close(self, is_last: bool) -> None:
        """Correct the main map by its loops, if new ones change it."""
        world = self.segments.main
        known = self._of(world)
        ids = world.keyframes.ids
        # The cost of a correction is proportional to the keyframes, and so is its interval.
        pause = max(self.config.close_every, len(ids) // 10)
        due = is_last or len(ids) - known.last_attempt >= pause
        if not known.pending or not due or self._asked is not None:
            return
        known.pending = 0
        known.last_attempt = len(ids)
        question = self._question(known)
        if question is None:
            return
        if self._thread is None or is_last:
            self._correct(question, close_loops(question))
        else:
            answer = self._thread.submit(close_loops, question)
            self._asked = _Asked(question, answer, world, self._age)

    def _question(self, known: SegmentConstraints) -> ClosingQuestion | None:
        """Return the input of a closing of the main map's loops; None where hardly anything
        matches: then the drift is unknown."""
        world = self.segments.main
        config = self.config
        keyframes = world.keyframes
        edges = world.map.graph.edges
        ids = keyframes.ids
        relative = joined([known.odometry, of_edges(keyframes, edges), known.loops])
        relative = between_positions(relative, ids)
        steps = ~relative.is_loop & ((relative.target - relative.source).abs() == 1)
        if not bool(steps.any()):
            return None
        matches = None
        if config.matches:
            matches = closing_matches(keyframes, edges, self.table.loops)
        return ClosingQuestion(
            ids,
            keyframes.poses(ids),
            relative,
            matches,
            max(len(world.segment.fixed), 1),
            world.segment.is_metric,
            {k: keyframes[k].inverse_depth for k in ids},
        )

    def _take_answer(self) -> None:
        """Apply the closing of the thread, or request another if the main map has changed since."""
        asked = self._asked
        self._asked = None
        assert asked is not None
        closure = asked.answer.result()
        world = self.segments.main
        if asked.world is world and asked.age == self._age:
            self._correct(asked.question, closure)
        else:
            self._of(world).pending += 1

    def _correct(self, question: ClosingQuestion, closure: LoopClosure | None) -> None:
        """Apply a closing, if it changes anything."""
        if closure is None:
            return
        world = self.segments.main
        keyframes = world.keyframes
        correction = brought_forward(closure.correction, {k.id: k.T_cw for k in keyframes})
        if self._change(correction) < self.config.min_change:
            return
        if closure.inverse_depth is not None:
            same = {
                k: depth
                for k, depth in zip(question.ids, closure.inverse_depth, strict=True)
                if k in keyframes and keyframes[k].inverse_depth is question.inverse_depths[k]
            }
            fixed = set(world.segment.fixed)
            edges = [e for e in world.map.graph.edges if e[0] not in fixed]
            take_over_depths(keyframes, edges, same)
        keyframes.correct(correction)
        _rescale(self._of(world), correction)
        self.table.closures += 1

    def _change(self, correction: PoseCorrection) -> float:
        """Return the largest change of a keyframe by a correction."""
        keyframes = self.segments.main.keyframes
        ids = sorted(correction.before)
        scale = torch.tensor([correction.scale[k] for k in ids], dtype=torch.float64)
        S = torch.stack([correction.after[k] for k in ids])
        S[:, :3] *= scale[:, None, None]
        before = torch.stack([correction.before[k] for k in ids])
        return float(disagreement(S, before, keyframes.median_depths(ids)).max())


def _rescale(known: SegmentConstraints, correction: PoseCorrection) -> None:
    """Rescale relative poses after a correction."""
    known.odometry = rescaled(known.odometry, correction.scale)
    known.loops = rescaled(known.loops, correction.scale)
