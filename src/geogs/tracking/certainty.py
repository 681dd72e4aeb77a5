"""How well a tracker knows its keyframes, by what all its matches leave open."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from geogs.bundle.base import BundleOptions
from geogs.bundle.marginals import Marginals, marginals
from geogs.tracking.graph import HUBER
from geogs.tracking.tracker import Tracker
from geogs.types import Uncertainty

TOGETHER = 300
"""Keyframes whose poses are looked at jointly; of longer videos the parts follow each other."""
USUAL_STRAIN = 0.23
"""Median residual, in deviations of a match, where the scene is as modelled."""
STRAIN_POWER = 4
"""Errors of poses grow with this power of the strain. Both were read off rendered videos with and
without rolling shutter, blur, noise and people who cross (docs/tracking.md has the table)."""


@dataclass(frozen=True)
class Certainty:
    """What matches leave open, and how far they contradict the model; earliest keyframe first."""

    keyframes: tuple[int, ...]
    """Ids."""
    position: Float64[np.ndarray, "n"]
    """Standard deviation of the camera's centre relative to the first keyframe, map units, all axes
    together; infinite where nothing is known, as the others."""
    rotation: Float64[np.ndarray, "n"]
    """Likewise of its orientation, radians."""
    depth: Float64[np.ndarray, "n"]
    """Of its depths, as a part of them: the median."""
    strain: Float64[np.ndarray, "n"]
    """Median residual of its matches, in their deviations."""

    def calibrated(self, tracker: Tracker) -> Uncertainty:
        """Deviations that hold where the scene is not as modelled, too: see ``STRAIN_POWER``."""
        strain = np.where(np.isfinite(self.strain), self.strain / USUAL_STRAIN, 1.0)
        strain = np.maximum(strain, 1.0)
        factor = float(np.mean(strain**STRAIN_POWER)) if len(strain) else 1.0
        times = [tracker.keyframes[k].timestamp for k in self.keyframes]
        return Uncertainty(
            np.array(times, np.float64), factor * self.position, factor * self.rotation,
            strain * self.depth,
        )  # fmt: skip


def certainty(tracker: Tracker) -> Certainty:
    """Of all keyframes of a tracker that has a map, from the edges that it has at present.

    In the world of a saved map: of those that it did not bring, relative to it.

    Lengths are relative to the length of the path: the unit of the map is anyone's. In a long
    video each part begins where the one before it ended, so that errors add up along the way
    whatever loops say: what is told of it is rather too much.
    """
    ids = tracker.segment.free
    position, rotation, depth, strain = (np.full(len(ids), np.inf) for _ in range(4))
    carried = np.zeros(2)
    for first in range(0, max(len(ids) - 1, 1), TOGETHER):
        part = slice(first, first + TOGETHER + 1)
        found = _marginals(tracker, ids[part])
        if found is None:
            continue
        squares = found.pose.diagonal(dim1=-2, dim2=-1).reshape(-1, 2, 3).sum(-1).numpy()
        squares = squares + carried
        position[part], rotation[part] = np.sqrt(squares).T
        depth[part], strain[part] = found.depth_deviation.numpy(), found.normalised_residual.numpy()
        carried = squares[-1] if not tracker.segment.fixed else carried
    return Certainty(tuple(ids), position, rotation, depth, strain)


def _marginals(tracker: Tracker, ids: list[int]) -> Marginals | None:
    """Of some keyframes, by the edges between them; none where there are none."""
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
