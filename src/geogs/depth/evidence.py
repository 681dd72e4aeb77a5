"""The tracker's depth and its weight against the sweep's, at the render size."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from geogs.depth.grid_completion import CompletedDepth, upsample_grid
from geogs.depth.plane_sweep import SweepResult
from geogs.geometry.camera import Camera

CONFIDENT_DEVIATION = 0.05
"""Relative deviation at which the confidence in the tracker is 1/2."""
TRACKER_SCALE = 0.5
"""Assumed ratio of real to expected relative deviation of the tracker's depth: more than the median
of 0.2 on rendered rooms, as a cell near an edge may be of either side."""
UNKNOWN_DEVIATION = 10.0
"""Relative deviation of a cell that the completion rejected."""
BEST_DEVIATION = 0.002
"""Least relative deviation of the tracker's depth."""
KINK = 0.04
"""Relative second difference of inverse depth between cells that marks a depth edge."""


@dataclass(frozen=True, slots=True)
class TrackerEvidence:
    """The completed depth of the tracker at the render size, and its weights."""

    inverse_depth: Float32[np.ndarray, "h w"]
    prior_weight: Float32[np.ndarray, "h w"]
    """Confidence in [0, 1], for the sweep."""
    precision: Float32[np.ndarray, "h w"]
    """Relative precision, for the refinement."""


def tracker_evidence(completed: CompletedDepth, working: Camera, render: Camera) -> TrackerEvidence:
    """The completed depth with its ``prior_weight`` and ``relative_precision``."""
    grids = (completed.inverse_depth, prior_weight(completed), relative_precision(completed))
    return TrackerEvidence(*(upsample_grid(grid, working, render) for grid in grids))


def prior_weight(completed: CompletedDepth) -> Float32[np.ndarray, "gh gw"]:
    """1 / (1 + (deviation / CONFIDENT_DEVIATION)^2) on the grid, 0 where the tracker was rejected.

    It falls to 0 where inverse depth bends sharply between cells: there it is interpolated from
    foreground to background.
    """
    weight = 1.0 / (1.0 + (completed.deviation / np.float32(CONFIDENT_DEVIATION)) ** 2)
    return np.where(completed.inlier, _flatness(completed.inverse_depth) * weight, np.float32(0.0))


def relative_precision(completed: CompletedDepth) -> Float32[np.ndarray, "gh gw"]:
    """1 / sigma^2 on the grid.

    sigma is ``TRACKER_SCALE`` times the deviation that the tracker expects. As ``prior_weight``, it
    falls to about 0 where inverse depth bends and where the completion rejected the tracker.
    """
    deviation = np.where(completed.inlier, completed.deviation, np.float32(UNKNOWN_DEVIATION))
    sigma = np.maximum(np.float32(TRACKER_SCALE) * deviation, np.float32(BEST_DEVIATION))
    return _flatness(completed.inverse_depth) ** 2 / sigma**2


def choose_start(
    tracker: TrackerEvidence, sweep: SweepResult
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """The inverse depth to refine, and the weight of each pixel in the first plane fits.

    The depth is the sweep's, or the tracker's where that is confident and the sweep not better.
    """
    prior = tracker.inverse_depth
    confidence = tracker.prior_weight
    unique = np.clip(0.5 * sweep.margin - 0.25, 0.0, 1.0) * (sweep.cost < 0.8)
    agree = np.abs(sweep.inverse_depth / prior - 1.0) < 0.05
    taken = (agree & (confidence > 0.3)) | ((confidence > 0.5) & (unique < 0.3))
    both = np.where(agree, np.maximum(confidence, unique), confidence)
    inverse_depth = np.where(taken, prior, sweep.inverse_depth).astype(np.float32)
    weight = np.where(taken, both, 0.7 * unique).astype(np.float32)
    return inverse_depth, weight + np.float32(0.02)


def _flatness(inverse_depth: Float32[np.ndarray, "gh gw"]) -> Float32[np.ndarray, "gh gw"]:
    """Weight near 1 on planes, near 0 where inverse depth bends sharply between cells."""
    q = inverse_depth
    bend = np.zeros_like(inverse_depth)
    bend[:, 1:-1] = np.abs(q[:, 2:] + q[:, :-2] - 2.0 * q[:, 1:-1])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(q[2:] + q[:-2] - 2.0 * q[1:-1]))
    return np.exp(-((bend / (np.float32(KINK) * q)) ** 2))
