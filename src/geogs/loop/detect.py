"""Loop detection: pairs of keyframes far apart in time that show the same place."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import islice

import numpy as np
import torch
from jaxtyping import Bool, UInt8

from geogs.config import LoopConfig
from geogs.geometry.lie import se3_inverse
from geogs.loop.dense_check import dense_check
from geogs.loop.search import SUPPRESSION, Depths, PlaceRecognition, Query
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.graph.proximity import frame_distances
from geogs.tracking.locate.frame_locator import Recognition
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeTable
from geogs.world.loops import Loop, LoopTable, VerifiedCandidate

MAX_FLOW_DISTANCE = 0.29
"""Flow distance below which the present poses make a pair a candidate, as a fraction of the long
edge (22 cells of 8 pixels at 616 pixels, as in HI-SLAM2)."""
ROTATION_WEIGHT = 0.3
"""Weight of the flow with rotation in that distance; the rest is without rotation, as a place may
be revisited from another direction."""
MAX_ANGLE_DEG = 120.0
"""Largest angle between the orientations of such a pair."""
MAX_BASELINE = 1.5
"""Largest distance between their centres, over the keyframe's median depth."""
MEASURED = 48
"""Most such pairs, nearest first, whose flow distance is computed: bounds the cost."""
MIN_MATCHED_ALONE = 0.3
"""Least fraction of the cells whose flow agrees where only the present poses, and no features,
support the loop."""
MAX_LOOPS = 2
"""Most loops per keyframe: more of one place are redundant."""
LAG = 2
"""Number of keyframes for which a search may run in parallel to tracking before it is awaited."""


class LoopDetector:
    """Finds loops at final keyframes: appearance and features propose, dense flow decides.

    Place recognition runs in a thread concurrently with tracking; its results are used ``LAG``
    keyframes later, at the same frame however fast the machine is. Keyframes may lie in several
    segments with unrelated gauges: between these, only appearance proposes.
    """

    def __init__(
        self,
        keyframes: KeyframeTable,
        operator: FlowOperator,
        config: LoopConfig,
        waits: bool = True,
        mask: Bool[np.ndarray, "h w"] | None = None,
        table: LoopTable | None = None,
    ) -> None:
        """Unless it ``waits`` for slow searches, their results are used later.

        Outside a ``mask`` of the size of the images no features are detected.
        """
        self.keyframes = keyframes
        self.grid = keyframes.grid
        self.operator = operator
        self.config = config
        self._waits = waits
        # The search reads data written in the stream in which the detector was made.
        stream = torch.cuda.current_stream() if keyframes.grid.on_gpu else None
        self._thread = ThreadPoolExecutor(
            max_workers=1,
            thread_name_prefix="loops",
            initializer=lambda: None if stream is None else torch.cuda.set_stream(stream),
        )
        self.table = table or LoopTable()
        self._order = {id: rank for rank, id in enumerate(self.table.keyframes)}
        """Rank in time of each keyframe searched so far."""
        self._search = PlaceRecognition(self.grid, self.config, self._order, mask, self.table)
        self._pending: deque[Future[None] | None] = deque(None for _ in self.table.found)
        """Search for each keyframe without a decision yet; None where it was done before."""

    def settle(self) -> None:
        """Finish the running searches, so that the table has their results."""
        for search in self._pending:
            _finish(search)

    def update(
        self, ids: Sequence[int], is_last: bool = False, settled: Sequence[Pair] = ()
    ) -> tuple[Loop, ...]:
        """Add keyframes that became final, earliest first, and return the loops found.

        They are those of the keyframes ``LAG`` earlier, and at the end those of all. No loop is
        searched near ``settled`` pairs of keyframes.
        """
        found: list[Loop] = []
        for id in ids:
            self._enter(id)
            ranked = self._ranked(settled)
            self._pending.append(self._thread.submit(self._search.find, self._query(id, ranked)))
            first = self._pending[0]
            is_there = self._waits or first is None or first.done()
            if len(self._pending) > LAG and is_there:
                found += self._decide(ranked)
        while is_last and self._pending:
            found += self._decide(self._ranked(settled))
        return tuple(found)

    def remember(self, ids: Sequence[int]) -> None:
        """Add keyframes for recognition only, without searching their loops."""
        for id in ids:
            self._enter(id)
            self._thread.submit(self._search.remember, id, self.keyframes[id].image)

    def recognise(self, image: UInt8[np.ndarray, "h w 3"]) -> list[Recognition]:
        """Return keyframes recognised in an image, with its pose; most similar first."""
        return self._thread.submit(self._search.recognise, image, self._depths()).result()

    def candidates(self, id: int) -> list[int]:
        """Return keyframes that an added one revisits by the present poses, nearest first."""
        facing = self._facing(id)
        segment = self.keyframes.set_of[id]
        if not facing:
            return []
        directed = [(k, id) for k in facing] + [(id, k) for k in facing]
        there, back = frame_distances(segment, directed, ROTATION_WEIGHT).chunk(2)
        limit = MAX_FLOW_DISTANCE * self.grid.camera.long_edge
        distance, order = torch.sort(((there + back) / 2).cpu(), stable=True)
        return [facing[n] for n in order[distance < limit].tolist()]

    def _query(self, id: int, settled: Sequence[Pair]) -> Query:
        near = self._near(id)
        by_pose = tuple(self.candidates(id))
        known = tuple(self._found_near(id))
        features = self._search.describe(self.keyframes[id].image)
        return Query(id, features, near, by_pose, known, tuple(settled), self._depths())

    def _ranked(self, pairs: Sequence[Pair]) -> list[Pair]:
        """Return the pairs whose keyframes have both been added."""
        return [p for p in pairs if p[0] in self._order and p[1] in self._order]

    def _enter(self, id: int) -> None:
        """Add a keyframe as the latest."""
        self.table.keyframes.append(id)
        self._order[id] = len(self._order)

    def _found_near(self, id: int) -> list[Pair]:
        """Return the pairs of loops whose later keyframe is near enough to this one to suppress its
        candidates; loops are ordered by their later keyframes."""
        rank = self._order[id]
        loops = self.table.loops
        first = bisect_left(loops, rank - SUPPRESSION, key=self._later_rank)
        last = bisect_right(loops, rank + SUPPRESSION, key=self._later_rank)
        return [(loop.first, loop.second) for loop in loops[first:last]]

    def _later_rank(self, loop: Loop) -> int:
        return self._order[loop.second]

    def _is_implied(self, id: int, found: Sequence[Loop], settled: Sequence[Pair]) -> bool:
        """Whether a keyframe is already linked with one in a loop found for the same keyframe."""
        pairs = ((min(id, loop.first), max(id, loop.first)) for loop in found)
        return any(
            self._search.is_suppressed(pair, self._found_near(pair[1]), settled) for pair in pairs
        )

    def _near(self, id: int) -> frozenset[int]:
        """Return the keyframe itself and those near it in time in the same segment."""
        segment = self.keyframes.set_of[id]
        recent = self.table.keyframes[self._first_near(id) :]
        return frozenset(k for k in recent if k in segment)

    def _first_near(self, id: int) -> int:
        """Return the rank of the first keyframe at most ``min_gap`` keyframes before one."""
        return max(self._order[id] - self.config.min_gap, 0)

    def _depths(self) -> Depths:
        """Return the present depths of all keyframes; they are replaced, never changed."""
        states = {k: self.keyframes[k] for k in self._order}
        return {k: (s.inverse_depth, s.information) for k, s in states.items()}

    def _facing(self, id: int) -> list[int]:
        """Return a few nearest earlier keyframes with a similar viewing direction."""
        segment = self.keyframes.set_of[id]
        old = np.array(self.table.keyframes[: self._first_near(id)], np.int64)
        depth = 1 / float(segment[id].inverse_depth.median())
        around = self.keyframes.poses.around(id, old, MAX_ANGLE_DEG, MAX_BASELINE * depth)
        return list(islice((k for k in around.tolist() if k in segment), MEASURED))

    def _decide(self, settled: Sequence[Pair]) -> list[Loop]:
        """Return the loops among the candidates of the next keyframe."""
        _finish(self._pending.popleft())
        found: list[Loop] = []
        for view in self.table.found.pop(0):
            pair = view.candidate.first, view.candidate.second
            found_near = self._found_near(view.candidate.second)
            if self._search.is_suppressed(pair, found_near, settled):
                continue
            if self._is_implied(pair[0], found, settled):
                continue
            loop = self._verify(view)
            if loop is None:
                continue
            found.append(loop)
            # In a long video the flows of all loops would fill the memory.
            kept = loop if self.config.matches else replace(loop, there=None, back=None)
            self.table.loops.append(kept)
            if len(found) == MAX_LOOPS:
                break
        return found

    def _verify(self, verified: VerifiedCandidate) -> Loop | None:
        """Return the loop of a candidate if the flow confirms it, else None.

        The initial pose is that of the features, or the present one where they failed: plain
        surfaces have few corners, but when the drift is small the flow needs none.
        """
        p = verified.candidate
        view = verified.view
        first = self.keyframes[p.first]
        second = self.keyframes[p.second]
        grid = self.grid
        if view.accepted and view.is_metric and view.T_ji is not None:
            T = view.T_ji
            scale = view.scale or 1.0
            inliers = view.inliers
        elif p.cause == "geometry":
            T = second.T_cw @ se3_inverse(first.T_cw)
            scale = 1.0
            inliers = 0
        else:
            return None
        check = dense_check(grid, self.operator, first, second, T, scale)
        if not inliers and check.matched < MIN_MATCHED_ALONE:
            return None
        if not check.accepted or check.T_ji is None:
            return None
        return Loop(
            p.first,
            p.second,
            p.cause,
            check.T_ji,
            check.scale,
            inliers,
            check.matched,
            check.there,
            check.back,
        )


def _finish(search: Future[None] | None) -> None:
    """Wait for a search that may be running; re-raises its exception."""
    if search is not None:
        search.result()
