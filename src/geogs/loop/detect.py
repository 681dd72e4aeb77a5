"""Loops: pairs of keyframes far apart in time that show one place."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.config import LoopConfig
from geogs.geometry.lie import se3_inverse, so3_log
from geogs.loop.dense import dense_check
from geogs.loop.features import Features
from geogs.loop.retrieval import AppearanceIndex
from geogs.loop.verification import DepthView, TwoViewVerifier
from geogs.tracking.flow.base import FlowMatch, FlowOperator
from geogs.tracking.grid import SampleGrid
from geogs.tracking.keyframes import KeyframeState, KeyframeStore
from geogs.tracking.motion import Recognition
from geogs.tracking.proximity import frame_distances

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
    there: FlowMatch
    """The flow from the first to the second, one edge."""
    back: FlowMatch

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
    """Proposes loops by present poses and by looks, and keeps those that two checks accept.

    Keyframes may lie in several stores, whose poses then have nothing to do with each other:
    between them, only looks propose.
    """

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        store_of: Callable[[int], KeyframeStore],
        config: LoopConfig | None = None,
    ) -> None:
        """``store_of`` says where a keyframe is at present."""
        self.grid = grid
        self.operator = operator
        self.store_of = store_of
        self.config = config or LoopConfig()
        self.index = AppearanceIndex(self.config.retrieval)
        self.refusals: list[Refusal] = []
        """Of the last update."""
        self._verifier = TwoViewVerifier(grid.camera, self.config.verification)
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
            self._features[id] = self.index.describe(self._state(id).image)
            found += self._close(id)
            self.index.add(id, self._features[id])
        return tuple(found)

    def recognise(self, image: UInt8[np.ndarray, "h w 3"]) -> list[Recognition]:
        """Keyframes that show what an image shows, with its pose; most alike first."""
        features = self.index.describe(image)
        found: list[Recognition] = []
        for candidate in self.index.query(features, (), self.config.appearance):
            if candidate.score < self.config.min_score:
                continue
            id = candidate.keyframe
            known = DepthView.of(self.grid, self._state(id), self._features[id])
            view = self._verifier.verify(known, DepthView(features))
            if view.accepted and view.is_metric and view.T_ji is not None:
                found.append(Recognition(id, view.T_ji))
        return found

    def propose(self, id: int) -> list[Proposal]:
        """Pairs of a taken keyframe with earlier ones, thinned: geometry and looks take turns."""
        store, gap = self.store_of(id), self._order[id] - self.config.min_gap
        here = [k for k in self._order if k != id and self.store_of(k) is store]
        near = {k for k in here if self._order[k] >= gap}
        by_pose = self._by_pose(id, [k for k in here if k not in near])
        by_looks = self._by_looks(id, near | {id})
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

    def _state(self, id: int) -> KeyframeState:
        return self.store_of(id)[id]

    def _by_pose(self, id: int, old: Sequence[int]) -> list[int]:
        """Keyframes that the present poses say are seen again, nearest first."""
        if not old:
            return []
        near = self._facing(id, old)
        directed = [(k, id) for k in near] + [(id, k) for k in near]
        store = self.store_of(id)
        there, back = frame_distances(store, directed, self.config.rotation_weight).chunk(2)
        limit = self.config.max_distance * max(self.grid.camera.width, self.grid.camera.height)
        distance, order = torch.sort(((there + back) / 2).cpu(), stable=True)
        return [near[n] for n in order[distance < limit].tolist()]

    def _facing(self, id: int, old: Sequence[int]) -> list[int]:
        """The keyframes nearest by that look roughly the same way; there are never many."""
        store = self.store_of(id)
        state, T = store[id], store.poses(old)
        angle = torch.rad2deg(so3_log(state.T_cw[:3, :3] @ T[:, :3, :3].mT).norm(dim=-1))
        away = (se3_inverse(T)[:, :3, 3] - se3_inverse(state.T_cw)[:3, 3]).norm(dim=-1)
        depth = 1 / float(state.inverse_depth.median())
        facing = (angle < self.config.max_angle) & (away < self.config.max_baseline * depth)
        order = torch.argsort(away, stable=True)
        return [old[n] for n in order.tolist() if facing[n]][: self.config.measured]

    def _by_looks(self, id: int, excluded: set[int]) -> list[int]:
        """Keyframes that look alike, most alike first."""
        found = self.index.query(self._features[id], excluded, self.config.appearance)
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
        first, second, grid = self._state(p.first), self._state(p.second), self.grid
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
        if not check.accepted or check.T_ji is None or check.there is None or check.back is None:
            return Refusal(p, check.reason)
        return Loop(
            p.first, p.second, p.source, check.T_ji, check.scale, inliers, check.matched,
            check.there, check.back,
        )  # fmt: skip
