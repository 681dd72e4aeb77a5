"""Loops: pairs of keyframes far apart in time that show one place."""

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
"""Flow distance below which the present poses make a pair a candidate, of the long edge (22 cells
of 8 pixels at 616 pixels, as HI-SLAM2 has it)."""
ROTATION_WEIGHT = 0.3
"""Weight of the flow with the rotation in that distance, the rest is without: a place may be seen
again from another direction."""
MAX_ANGLE_DEG = 120.0
"""Largest angle between the orientations of such a pair."""
MAX_BASELINE = 1.5
"""Largest distance between their centres, of the keyframe's median depth."""
MEASURED = 48
"""Most such pairs, nearest first, whose flow distance is computed: bounds the cost."""
MIN_MATCHED_ALONE = 0.3
"""Least fraction of the cells whose flow agrees where only the present poses, and no features,
speak for the loop."""
MAX_LOOPS = 2
"""Most loops per keyframe: more of one place say the same."""
LAG = 2
"""Keyframes for which a search may run beside tracking before it is waited for."""


class LoopDetector:
    """Finds loops at final keyframes: appearance and features propose, dense flow decides.

    Place recognition runs in a thread concurrently with tracking; what it finds is taken up
    ``LAG`` keyframes later, at the same frame however fast the machine is. Keyframes
    may lie in several segments, whose poses have nothing to do with each other: between them, only
    appearance proposes.
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
        """Unless it ``waits`` for searches that take longer, what they find is taken up later.

        Outside a ``mask`` of the size of the images no features are found.
        """
        self.keyframes = keyframes
        self.grid = keyframes.grid
        self.operator = operator
        self.config = config
        self._waits = waits
        # What the search reads was written in the stream of whoever made the detector.
        stream = torch.cuda.current_stream() if keyframes.grid.on_gpu else None
        self._thread = ThreadPoolExecutor(
            max_workers=1, thread_name_prefix="loops",
            initializer=lambda: None if stream is None else torch.cuda.set_stream(stream),
        )  # fmt: skip
        self.table = table or LoopTable()
        self._order = {id: rank for rank, id in enumerate(self.table.keyframes)}
        """Rank in time of each keyframe searched so far."""
        self._search = PlaceRecognition(self.grid, self.config, self._order, mask, self.table)
        self._pending: deque[Future[None] | None] = deque(None for _ in self.table.found)
        """The search for each keyframe that is not decided yet; none where it was done before."""

    def settle(self) -> None:
        """Finish the searches that are under way, so that the table holds what they found."""
        for search in self._pending:
            _finish(search)

    def update(
        self, ids: Sequence[int], is_last: bool = False, settled: Sequence[Pair] = ()
    ) -> tuple[Loop, ...]:
        """Take keyframes that became final, earliest first, and return loops that were found.

        They are those of the keyframes ``lag`` earlier, and at the end of all. None is looked for
        near pairs of keyframes that are ``settled``.
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
        """Take keyframes that are to be recognised, and are loops of none before them."""
        for id in ids:
            self._enter(id)
            self._thread.submit(self._search.remember, id, self.keyframes[id].image)

    def recognise(self, image: UInt8[np.ndarray, "h w 3"]) -> list[Recognition]:
        """Keyframes that show what an image shows, with its pose; most alike first."""
        return self._thread.submit(self._search.recognise, image, self._depths()).result()

    def candidates(self, id: int) -> list[int]:
        """Keyframes that the present poses say a taken one sees again, nearest first."""
        facing, segment = self._facing(id), self.keyframes.set_of[id]
        if not facing:
            return []
        directed = [(k, id) for k in facing] + [(id, k) for k in facing]
        there, back = frame_distances(segment, directed, ROTATION_WEIGHT).chunk(2)
        limit = MAX_FLOW_DISTANCE * self.grid.camera.long_edge
        distance, order = torch.sort(((there + back) / 2).cpu(), stable=True)
        return [facing[n] for n in order[distance < limit].tolist()]

    def _query(self, id: int, settled: Sequence[Pair]) -> Query:
        near, by_pose = self._near(id), tuple(self.candidates(id))
        known = tuple(self._found_near(id))
        features = self._search.describe(self.keyframes[id].image)
        return Query(id, features, near, by_pose, known, tuple(settled), self._depths())

    def _ranked(self, pairs: Sequence[Pair]) -> list[Pair]:
        """The pairs of keyframes taken so far."""
        return [p for p in pairs if p[0] in self._order and p[1] in self._order]

    def _enter(self, id: int) -> None:
        """Take a keyframe as the latest."""
        self.table.keyframes.append(id)
        self._order[id] = len(self._order)

    def _found_near(self, id: int) -> list[Pair]:
        """Pairs of the loops found whose later keyframe is so near to one that they can rule out
        others of it; loops are found in the order of their later keyframes."""
        rank, loops = self._order[id], self.table.loops
        first = bisect_left(loops, rank - SUPPRESSION, key=self._later_rank)
        last = bisect_right(loops, rank + SUPPRESSION, key=self._later_rank)
        return [(loop.first, loop.second) for loop in loops[first:last]]

    def _later_rank(self, loop: Loop) -> int:
        return self._order[loop.second]

    def _is_implied(self, id: int, found: Sequence[Loop], settled: Sequence[Pair]) -> bool:
        """Whether a place was joined before with one that a loop of the same keyframe has found."""
        pairs = ((min(id, loop.first), max(id, loop.first)) for loop in found)
        return any(
            self._search.is_suppressed(pair, self._found_near(pair[1]), settled) for pair in pairs
        )

    def _near(self, id: int) -> frozenset[int]:
        """The keyframe itself and those of the same time and segment."""
        segment, recent = self.keyframes.set_of[id], self.table.keyframes[self._first_near(id) :]
        return frozenset(k for k in recent if k in segment)

    def _first_near(self, id: int) -> int:
        """Rank of the first keyframe at most ``min_gap`` keyframes before one."""
        return max(self._order[id] - self.config.min_gap, 0)

    def _depths(self) -> Depths:
        """What is known of the depth of all keyframes now; they are replaced, never changed."""
        states = {k: self.keyframes[k] for k in self._order}
        return {k: (s.inverse_depth, s.information) for k, s in states.items()}

    def _facing(self, id: int) -> list[int]:
        """The earlier keyframes nearest by that look roughly the same way; there are never many."""
        segment = self.keyframes.set_of[id]
        old = np.array(self.table.keyframes[: self._first_near(id)], np.int64)
        depth = 1 / float(segment[id].inverse_depth.median())
        around = self.keyframes.poses.around(id, old, MAX_ANGLE_DEG, MAX_BASELINE * depth)
        return list(islice((k for k in around.tolist() if k in segment), MEASURED))

    def _decide(self, settled: Sequence[Pair]) -> list[Loop]:
        """The loops among the candidates of the keyframe whose turn it is."""
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
            # Of a long video the flows of all loops would fill the memory.
            kept = loop if self.config.matches else replace(loop, there=None, back=None)
            self.table.loops.append(kept)
            if len(found) == MAX_LOOPS:
                break
        return found

    def _verify(self, verified: VerifiedCandidate) -> Loop | None:
        """The loop that a candidate is, if it is one.

        Features found the pose, the flow confirms it; where they failed, present poses may do.
        Plain surfaces have few corners, but when the drift is small the flow needs none.
        """
        p, view = verified.candidate, verified.view
        first, second, grid = self.keyframes[p.first], self.keyframes[p.second], self.grid
        if view.accepted and view.is_metric and view.T_ji is not None:
            T, scale, inliers = view.T_ji, view.scale or 1.0, view.inliers
        elif p.cause == "geometry":
            T, scale, inliers = second.T_cw @ se3_inverse(first.T_cw), 1.0, 0
        else:
            return None
        check = dense_check(grid, self.operator, first, second, T, scale)
        if not inliers and check.matched < MIN_MATCHED_ALONE:
            return None
        if not check.accepted or check.T_ji is None:
            return None
        return Loop(
            p.first, p.second, p.cause, check.T_ji, check.scale, inliers, check.matched,
            check.there, check.back,
        )  # fmt: skip


def _finish(search: Future[None] | None) -> None:
    """Wait for a search that may be under way; raises what it has raised."""
    if search is not None:
        search.result()
