"""Loops: pairs of keyframes far apart in time that show one place."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse, so3_log
from geogs.loop.dense import dense_check
from geogs.loop.features import Features
from geogs.config import LoopConfig
from geogs.loop.retrieval import AppearanceIndex
from geogs.loop.verification import DepthView, TwoViewVerifier
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.graph import frame_distances
from geogs.tracking.keyframes import KeyframeStore

Source = Literal["geometry", "appearance"]
"""What proposed a pair: the present poses, or nothing but the looks."""


@dataclass(frozen=True)
class Proposal:
    """A pair that may be a loop."""

    first: int
    second: int
    """The later."""
    source: Source


@dataclass(frozen=True)
class Loop:
    """A pair that is one."""

    first: int
    second: int
    """The later keyframe."""
    source: Source
    T_ji: Float[Tensor, "4 4"]
    """First camera to second in the lengths of the first keyframe's depth, float64."""
    scale: float
    """Lengths of the second's depth per length of the first's: what drifted in between."""
    inliers: int
    """Features that agree with the pose; 0 where the flow alone found it."""
    matched: float
    """Share of the cells whose flow does."""

    @property
    def S_ji(self) -> Float[Tensor, "4 4"]:
        """Sim(3) that takes points of the first camera, in its lengths, to the second in its."""
        S = self.scale * self.T_ji
        S[3, 3] = 1.0
        return S


@dataclass(frozen=True)
class Refusal:
    """A proposal that came to nothing."""

    proposal: Proposal
    reason: str


class LoopDetector:
    """Proposes loops by present poses and by looks, and keeps those that two checks accept."""

    def __init__(
        self, store: KeyframeStore, operator: FlowOperator, config: LoopConfig | None = None
    ) -> None:
        self.store = store
        self.operator = operator
        self.config = config or LoopConfig()
        self.index = AppearanceIndex(self.config.retrieval)
        self.refusals: list[Refusal] = []
        """Of the last update."""
        self._verifier = TwoViewVerifier(store.grid.camera, self.config.verification)
        self._features: dict[int, Features] = {}
        self._order: dict[int, int] = {}
        """Place in time of each keyframe taken so far."""
        self._loops: list[Loop] = []

    @property
    def loops(self) -> tuple[Loop, ...]:
        """All that were found, earliest first."""
        return tuple(self._loops)

    def update(self, ids: Sequence[int]) -> tuple[Loop, ...]:
        """Take keyframes that became final, earliest first, and return the loops they close."""
        self.refusals = []
        found: list[Loop] = []
        for id in ids:
            self._order[id] = len(self._order)
            self._features[id] = self.index.describe(self.store[id].image)
            found += self._close(id)
            self.index.add(id, self._features[id])
        return tuple(found)

    def propose(self, id: int) -> list[Proposal]:
        """Pairs of a taken keyframe with earlier ones, thinned: geometry and looks take turns."""
        old = [k for k in self._order if self._order[k] < self._order[id] - self.config.min_gap]
        by_pose, by_looks = self._by_pose(id, old), self._by_looks(id, set(old))
        turns: list[Proposal] = []
        for n in range(max(len(by_pose), len(by_looks))):
            # Where the poses agree with the looks, the flow may start from them if features fail.
            turns += [
                Proposal(k, id, "geometry" if k in by_pose else "appearance")
                for k in by_looks[n : n + 1]
            ]
            turns += [Proposal(k, id, "geometry") for k in by_pose[n : n + 1]]
        kept: list[Proposal] = []
        for p in turns:
            if not self._suppressed(p, [*kept, *self._loops]):
                kept.append(p)
        return kept[: self.config.verified]

    def _by_pose(self, id: int, old: Sequence[int]) -> list[int]:
        """Keyframes that the present poses say are seen again, nearest first."""
        if not old:
            return []
        R = self.store.poses(old)[:, :3, :3]
        angle = torch.rad2deg(so3_log(self.store[id].T_cw[:3, :3] @ R.mT).norm(dim=-1))
        near = [k for k, a in zip(old, angle.tolist(), strict=True) if a < self.config.max_angle]
        directed = [(k, id) for k in near] + [(id, k) for k in near]
        there, back = frame_distances(self.store, directed, self.config.rotation_weight).chunk(2)
        camera = self.store.grid.camera
        limit = self.config.max_distance * max(camera.width, camera.height)
        distance, order = torch.sort(((there + back) / 2).cpu(), stable=True)
        return [near[n] for n in order[distance < limit].tolist()]

    def _by_looks(self, id: int, old: set[int]) -> list[int]:
        """Keyframes that look alike, most alike first."""
        if not old:
            return []
        recent = [k for k in self._order if k not in old]
        found = self.index.query(self._features[id], recent, self.config.appearance)
        return [c.keyframe for c in found if c.score >= self.config.min_score]

    def _suppressed(self, p: Proposal, others: Sequence[Proposal | Loop]) -> bool:
        """Whether a pair is too near to another to say anything new."""
        a, b = self._order[p.first], self._order[p.second]
        return any(
            abs(a - self._order[o.first]) + abs(b - self._order[o.second])
            <= self.config.suppression
            for o in others
        )

    def _close(self, id: int) -> list[Loop]:
        found: list[Loop] = []
        for proposal in self.propose(id):
            loop = self._verify(proposal)
            if isinstance(loop, Refusal):
                self.refusals.append(loop)
                continue
            found.append(loop)
            self._loops.append(loop)
            if len(found) == self.config.max_loops:
                break
        return found

    def _verify(self, p: Proposal) -> Loop | Refusal:
        """Features find the pose, the flow confirms it; where features fail, present poses may do.

        Plain surfaces have few corners, but when the drift is small the flow needs none.
        """
        first, second = self.store[p.first], self.store[p.second]
        grid = self.store.grid
        view = self._verifier.verify(
            DepthView.of(grid, first, self._features[p.first]),
            DepthView.of(grid, second, self._features[p.second]),
        )
        if view.accepted and view.is_metric and view.T_ji is not None:
            T, scale, inliers = view.T_ji, view.scale or 1.0, view.inliers
        elif p.source == "geometry":
            T, scale, inliers = second.T_cw @ se3_inverse(first.T_cw), 1.0, 0
        else:
            return Refusal(p, view.reason or "too little depth is known")
        check = dense_check(grid, self.operator, first, second, T, scale, self.config.verification)
        if not inliers and check.matched < self.config.verification.min_matched_alone:
            share = f"{check.matched:.0%}"
            return Refusal(p, check.reason or f"without features, {share} matched is too little")
        if not check.accepted or check.T_ji is None:
            return Refusal(p, check.reason)
        return Loop(p.first, p.second, p.source, check.T_ji, check.scale, inliers, check.matched)
