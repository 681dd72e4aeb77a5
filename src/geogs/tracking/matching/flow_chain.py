"""Flow chained from a first image through the following ones, while no depth is known."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.filled import filled_positions
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.keyframes.keyframe_choice import SeenMotion
from geogs.tracking.matching.photometric_check import (
    MIN_NCC,
    PhotometricCheck,
    correlation_matched,
    matched_motion,
)
from geogs.tracking.matching.sparse_features import guided_flow, guided_flows
from geogs.types import FlowMatch
from geogs.world.edges import Pair
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet
from geogs.world.segments import ChainedPositions

Positions = tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"]]
"""Positions of the cells of one keyframe in another, and of the other's cells in it."""

MIN_TEXTURE = 0.05
"""Textured fraction below which a frame is skipped."""
MIN_MATCHED = 0.12
"""Matched fraction of a keyframe below which the camera is lost."""


@dataclass(frozen=True, kw_only=True)
class ChainedMotion(SeenMotion):
    """Motion of a frame since the last keyframe while no depth is known; its overlap is 0 where the
    photometric check fails."""

    back: FlowMatch
    """One edge, frame -> keyframe."""


def follow_flow(
    grid: SampleGrid, operator: FlowOperator, chain: ChainedPositions, first: Any, encoded: Any
) -> ChainedMotion:
    """Match the first image with the next one, starting from ``chain``, which is updated.

    Both images are encoded.
    """
    there, back = operator.measure([first], [encoded], chain.there, chain.back, fine=False)
    there, back = guided_flow(grid, operator, first, encoded, there, back)
    # Photometric check at the flow's positions, for want of a pose.
    seen = correlation_matched(grid, operator.grey(first), operator.grey(encoded), there.pixels[0])
    moved = matched_motion(grid, there.pixels[0], there.weight[0])
    # Copied at once, to wait for a GPU only once.
    found = torch.cat([moved, seen]).cpu()
    matched, flow = found[:2].tolist()
    if not PhotometricCheck.of(found[2:]).passes(MIN_NCC, is_expected=True):
        matched = 0.0
    if matched > 0:
        chain.there = filled_positions(grid, there)[None]
        chain.back = filled_positions(grid, back)[None]
    return ChainedMotion(flow if matched else 0.0, matched, there, back=back)


class ChainedFlows:
    """Flows from the first of some keyframes to each of the others, while there is no map.

    Repeated attempts to start share most keyframes with the last one; their flows are kept.
    """

    def __init__(self, keyframes: KeyframeSet, operator: FlowOperator) -> None:
        self.keyframes = keyframes
        self.operator = operator
        self._steps: dict[Pair, Positions] = {}
        self._ids: list[int] = []
        """Keyframes of the last attempt."""
        self._flows: list[FlowMatch] = []
        self._reached: list[Positions] = []
        """Positions with unmatched cells filled in, from which the chain continues."""

    def measure(self) -> list[FlowMatch]:
        """Measure one edge from the first keyframe to each later one."""
        ids = self.keyframes.ids
        self._measure_steps(ids)
        same = next(
            (n for n, (a, b) in enumerate(zip(ids, self._ids, strict=False)) if a != b),
            min(len(ids), len(self._ids)),
        )
        kept = max(same - 1, 0)
        self._ids = ids
        self._flows = self._flows[:kept]
        self._reached = self._reached[:kept]
        for k in range(kept + 1, len(ids)):
            self._reach(ids, k)
        return list(self._flows)

    def forget(self) -> None:
        """Free all flows, once there is a map."""
        self._steps = {}
        self._ids = []
        self._flows = []
        self._reached = []

    def _reach(self, ids: list[int], k: int) -> None:
        """Measure the flow to the k-th keyframe from that to the one before it."""
        grid = self.keyframes.grid
        operator = self.operator
        step, back_step = self._steps[ids[k - 1], ids[k]]
        there = step
        back = back_step
        if k > 1:
            reached, returned = self._reached[k - 2]
            there = reached + grid.sample_field(step - grid.pixels, reached)
            back = back_step + grid.sample_field(returned - grid.pixels, back_step)
        first, last = (self.keyframes[ids[n]].encoded for n in (0, k))
        match, reverse = operator.measure([first], [last], there[None], back[None], fine=True)
        self._flows.append(match)
        self._reached.append((filled_positions(grid, match), filled_positions(grid, reverse)))

    def _measure_steps(self, ids: list[int]) -> None:
        """Measure the flow between consecutive keyframes, in both directions."""
        keyframes = self.keyframes
        operator = self.operator
        pairs = list(pairwise(ids))
        self._steps = {p: self._steps[p] for p in pairs if p in self._steps}
        new = [p for p in pairs if p not in self._steps]
        if not new:
            return
        first, second = ([keyframes[p[k]].encoded for p in new] for k in (0, 1))
        flows = guided_flows(keyframes.grid, operator, first, second)
        for pair, (there, back) in zip(new, flows, strict=True):
            self._steps[pair] = there.pixels[0], back.pixels[0]
