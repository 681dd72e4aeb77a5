"""Place recognition: the part of loop detection without flow, concurrent with tracking."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.config import LoopConfig
from geogs.loop.orb_features import orb_features
from geogs.loop.retrieval import AppearanceIndex
from geogs.loop.settled import REACH
from geogs.loop.verification import FeatureView, TwoViewVerifier
from geogs.threads import worker_count
from geogs.tracking.locate.frame_locator import Recognition
from geogs.world.edges import Pair
from geogs.world.grid import SampleGrid
from geogs.world.loops import ImageFeatures, LoopCandidate, LoopTable, VerifiedCandidate

MIN_SCORE = 0.05
"""Least similarity of a candidate by appearance, relative to a keyframe's with itself."""
VERIFIED = 4
"""Most candidates of a keyframe that are verified: bounds the cost."""
SUPPRESSION = 3
"""Distance in keyframes, summed over both ends, within which a loop suppresses others as
redundant."""

Depths = Mapping[int, tuple[Float[Tensor, "p"], Float[Tensor, "p"]]]
"""Inverse depth and information on the grid, by keyframe."""


@dataclass(frozen=True)
class Query:
    """A keyframe to search loops for; immutable."""

    id: int
    features: Future[ImageFeatures]
    """Features of its image."""
    near: frozenset[int]
    """Keyframes excluded as loops, as they are near in time."""
    by_pose: tuple[int, ...]
    """Keyframes revisited by the present poses, nearest first."""
    known: tuple[Pair, ...]
    """Loops found so far."""
    settled: tuple[Pair, ...]
    """Pairs near which loops would be redundant."""
    depths: Depths


class PlaceRecognition:
    """Indexes keyframes by their features, and finds those that a new one may revisit."""

    def __init__(
        self,
        grid: SampleGrid,
        config: LoopConfig,
        order: Mapping[int, int],
        mask: Bool[np.ndarray, "h w"] | None,
        table: LoopTable,
    ) -> None:
        """``order`` is the rank in time of each keyframe; it may grow meanwhile. Outside a
        ``mask`` of the size of the images no features are detected."""
        self.table = table
        self.grid = grid
        self.config = config
        self.index = AppearanceIndex(self.table.vocabulary)
        self._mask = mask
        self._verifier = TwoViewVerifier(grid.camera)
        self._order = order
        self._helpers = ThreadPoolExecutor(
            min(worker_count(), VERIFIED), thread_name_prefix="recognition"
        )
        """Threads that detect features ahead of time, and verify several pairs at once."""

    def describe(self, image: UInt8[np.ndarray, "h w 3"]) -> Future[ImageFeatures]:
        """Detect the features of a keyframe in a helper thread."""
        return self._helpers.submit(orb_features, image, self._mask)

    def remember(self, id: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Index a keyframe without searching its loops."""
        self.table.features[id] = orb_features(image, self._mask)
        self.index.add(id, self.table.features[id])

    def find(self, query: Query) -> None:
        """Index a keyframe, and store its candidate pairs, most promising first."""
        id = query.id
        self.table.features[id] = query.features.result()
        candidates = self._candidates(query)
        first = [self._view(p.first, query.depths) for p in candidates]
        second = [self._view(p.second, query.depths) for p in candidates]
        seen = self._helpers.map(self._verifier.verify, first, second)
        verified = [VerifiedCandidate(p, view) for p, view in zip(candidates, seen, strict=True)]
        self.index.add(id, self.table.features[id])
        self.table.found.append(verified)

    def recognise(self, image: UInt8[np.ndarray, "h w 3"], depths: Depths) -> list[Recognition]:
        """Return keyframes recognised in an image, with its pose; most similar first."""
        features = orb_features(image, self._mask)
        found = []
        for id in self._similar(features, frozenset()):
            view = self._verifier.verify(self._view(id, depths), FeatureView(features))
            if view.accepted and view.is_metric and view.T_ji is not None:
                found.append(Recognition(id, view.T_ji))
        return found

    def is_suppressed(self, pair: Pair, found: Sequence[Pair], settled: Sequence[Pair]) -> bool:
        """Whether a pair is redundant, being near to one that was found or is settled."""
        near = chain(((p, SUPPRESSION) for p in found), ((p, REACH) for p in settled))
        a, b = (self._order[k] for k in pair)
        return any(
            abs(a - self._order[first]) + abs(b - self._order[second]) <= reach
            for (first, second), reach in near
        )

    def _candidates(self, query: Query) -> list[LoopCandidate]:
        """Return thinned pairs of a keyframe with earlier ones, by poses and appearance in turn."""
        id = query.id
        by_pose = query.by_pose
        by_appearance = self._similar(self.table.features[id], query.near)
        alternating: list[LoopCandidate] = []
        for n in range(max(len(by_pose), len(by_appearance))):
            # Where the poses propose it, too, the flow may start from them if features fail.
            alternating += [
                LoopCandidate(k, id, "geometry" if k in by_pose else "appearance")
                for k in by_appearance[n : n + 1]
            ]
            alternating += [LoopCandidate(k, id, "geometry") for k in by_pose[n : n + 1]]
        kept: list[Pair] = []
        chosen: list[LoopCandidate] = []
        for p in alternating:
            pair = p.first, p.second
            if not self.is_suppressed(pair, [*kept, *query.known], query.settled):
                kept.append(pair)
                chosen.append(p)
        return chosen[:VERIFIED]

    def _similar(self, features: ImageFeatures, excluded: frozenset[int]) -> list[int]:
        """Return keyframes of similar appearance, most similar first."""
        found = self.index.query(features, excluded, self.config.appearance)
        return [c.keyframe for c in found if c.score >= MIN_SCORE]

    def _view(self, id: int, depths: Depths) -> FeatureView:
        return FeatureView.of(self.grid, *depths[id], self.table.features[id])
