"""Flow chained from a first image through the following ones, while no depth is known."""

from dataclasses import dataclass
from typing import Any

import torch

from geogs.tracking.flow.filled import filled_positions
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.keyframes.keyframe_choice import SeenMotion
from geogs.tracking.matching.photometric_check import (
    MIN_NCC,
    PhotometricCheck,
    correlation_matched,
    matched_motion,
)
from geogs.tracking.matching.sparse_features import guided_flow
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.segments import ChainedPositions

MIN_TEXTURE = 0.05
"""Textured fraction below which a frame is skipped."""
MIN_MATCHED = 0.12
"""Matched fraction of a keyframe below which the camera is lost."""


@dataclass(frozen=True)
class ChainedMatch:
    """Motion of a frame since the last keyframe while no depth is known."""

    there: FlowMatch
    """One edge, keyframe -> frame."""
    back: FlowMatch
    """One edge, frame -> keyframe."""
    flow: float
    """Median motion of the matched cells in pixels."""
    matched: float
    """Fraction of the cells that are matched; 0 where the photometric check fails."""

    @property
    def seen(self) -> SeenMotion:
        """Criteria for a new keyframe."""
        return SeenMotion(self.flow, self.matched, self.there)


def follow_flow(
    grid: SampleGrid, operator: FlowOperator, chain: ChainedPositions, first: Any, encoded: Any
) -> ChainedMatch:
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
    return ChainedMatch(there, back, flow if matched else 0.0, matched)
