"""The tracker's own depth as a keyframe's dense depth, without a search: the paper's D_f."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32

from geogs.depth.depth_engine import AlternativeSearch, DepthEngine, DepthTask, Progress, silent
from geogs.depth.depth_view import DenseDepth, DepthView, KeyframeDepth, PosedDepth
from geogs.depth.grid_completion import known_cells, upsample_grid
from geogs.geometry.camera import Camera

VALID_DEVIATION = 0.3
"""Relative deviation, estimated by the adjustment, up to which a cell's depth is valid."""


def enlarged_depth(
    grid: Float32[np.ndarray, "gh gw"],
    information: Float32[np.ndarray, "gh gw"],
    working: Camera,
    render: Camera,
) -> KeyframeDepth:
    """Inverse depth of the tracker's grid, bilinear between the cells that are valid.

    A pixel is valid, with confidence 1, if these have more than half of the weight; else it has the
    median depth with confidence 0.
    """
    valid = known_cells(grid, information)
    valid &= (VALID_DEVIATION * grid) ** 2 * information > 1
    fraction = upsample_grid(valid.astype(np.float32), working, render)
    total = upsample_grid(np.where(valid, grid, np.float32(0)), working, render)
    is_valid = fraction > 0.5
    typical = np.median(grid[valid]) if valid.any() else np.float32(1)
    inverse = np.where(is_valid, total / np.where(is_valid, fraction, 1), typical)
    return KeyframeDepth((1 / inverse).astype(np.float32), is_valid.astype(np.float32))


class TrackerDepthEngine(AlternativeSearch):
    """Depths of the bundle adjustment; a search engine votes on points."""

    def __init__(
        self, classical: DepthEngine, device: torch.device, render: Camera, working: Camera
    ) -> None:
        super().__init__(classical)
        self.device = device
        self.render = render
        self.working = working

    def observe(self, view: DepthView) -> None:
        """As in the protocol; nothing is matched."""

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol; neighbours and limits are not used."""
        grids = ((task.view.inverse_depth, task.view.information) for task in tasks)
        return [self._dense(enlarged_depth(*g, self.working, self.render)) for g in grids]

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """As in the protocol; the depths stay as they are."""
        return [d.depth for d in depths]

    def _dense(self, depth: KeyframeDepth) -> DenseDepth:
        known = depth.depth[depth.confidence > 0]
        typical = np.median(known if known.size else depth.depth)
        values, confidence = (
            torch.from_numpy(m).to(self.device) for m in (depth.depth, depth.confidence)
        )
        return DenseDepth(values, confidence, torch.tensor(typical))
