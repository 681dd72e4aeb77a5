"""How well a tracker knows its keyframes, by what all its matches leave open."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from geogs.bundle.marginals import Marginals, marginals
from geogs.bundle.protocols import BundleOptions
from geogs.tracking.graph.frame_graph import HUBER
from geogs.tracking.tracker import Tracker
from geogs.types import Uncertainty

TOGETHER = 300
"""Keyframes whose poses are solved jointly; of longer videos the parts follow each other."""
USUAL_RESIDUAL = 0.23
"""Median residual, in deviations of a match, where the scene is as modelled."""
RESIDUAL_POWER = 4
"""Errors of poses grow with this power of the residual. Both were read off rendered videos with and
without rolling shutter, blur, noise and people who cross (docs/tracking.md has the table)."""


@dataclass(frozen=True)
class KeyframeUncertainty:
    """What matches leave open, and how far they contradict the model; earliest keyframe first."""

    keyframes: tuple[int, ...]
    """Ids."""
    position: Float64[np.ndarray, "n"]
    """Standard deviation of the camera's centre relative to the first keyframe, map units, all axes
    together; infinite where nothing is known, as the others."""
    rotation: Float64[np.ndarray, "n"]
    """Likewise of its orientation, radians."""
    depth: Float64[np.ndarray, "n"]
    """Median relative deviation of its depths."""
    residual: Float64[np.ndarray, "n"]
    """Median residual of its matches, in their deviations."""

    def calibrated(self, tracker: Tracker) -> Uncertainty:
        """Deviations that hold where the scene is not as modelled, too: see ``RESIDUAL_POWER``."""
        residual = np.where(np.isfinite(self.residual), self.residual / USUAL_RESIDUAL, 1.0)
        residual = np.maximum(residual, 1.0)
        factor = float(np.mean(residual**RESIDUAL_POWER)) if len(residual) else 1.0
        times = [tracker.keyframes[k].timestamp for k in self.keyframes]
        return Uncertainty(
            np.array(times, np.float64), factor * self.position, factor * self.rotation,
            residual * self.depth,
        )  # fmt: skip


def keyframe_uncertainty(tracker: Tracker) -> KeyframeUncertainty:
    """Uncertainty of all keyframes of a tracker that has a map, from its present edges.

    In the world of a saved map: of those that it did not bring, relative to it.

    Lengths are relative to the length of the path: the unit of the map is anyone's. In a long
    video each part begins where the one before it ended, so that errors add up along the way
    whatever loops say: what is said of it is rather too much.
    """
    ids = tracker.segment.free
    position, rotation, depth, residual = (np.full(len(ids), np.inf) for _ in range(4))
    propagated = np.zeros(2)
    for first in range(0, max(len(ids) - 1, 1), TOGETHER):
        part = slice(first, first + TOGETHER + 1)
        found = _marginals(tracker, ids[part])
        if found is None:
            continue
        squares = found.pose.diagonal(dim1=-2, dim2=-1).reshape(-1, 2, 3).sum(-1).numpy()
        squares = squares + propagated
        position[part], rotation[part] = np.sqrt(squares).T
        depth[part], residual[part] = (
            found.depth_deviation.numpy(),
            found.normalised_residual.numpy(),
        )
        propagated = squares[-1] if not tracker.segment.fixed else propagated
    return KeyframeUncertainty(tuple(ids), position, rotation, depth, residual)


def _marginals(tracker: Tracker, ids: list[int]) -> Marginals | None:
    """Marginals of some keyframes, by the edges between them; none where there are none."""
    free = ids if tracker.segment.fixed else ids[1:]
    among = {*ids, *tracker.segment.fixed}
    edges = [e for e in tracker.map.graph.edges if among.issuperset(e)]
    if not edges:
        return None
    problem, frames = tracker.map.graph.streamed_problem(edges, free, ids)
    grid = tracker.keyframes.grid
    found = marginals(grid, problem, BundleOptions(huber=HUBER), cells=512)
    own = torch.tensor([frames.index(k) for k in ids])
    return Marginals(found.pose[own], found.relative_depth[own], found.normalised_residual[own])
