"""One line on whether a run is to be relied on, and why not."""

from dataclasses import dataclass

import numpy as np

from geogs.types import Trajectory, Uncertainty

MOST_LOST = 0.2
"""Share of the frames without a pose above which nothing is called reliable."""
MOST_OFF = 0.05
"""Deviation of the camera's place, of the extent of its path."""
MOST_DEEP = 0.2
"""Relative deviation of depths."""


@dataclass(frozen=True)
class Verdict:
    """What a run knows of itself."""

    is_reliable: bool
    sentence: str
    """For the terminal."""
    lost: float
    """Share of the frames without a pose."""
    position: float
    """Median deviation of the camera's place, of the extent of its path: the root of the mean
    squared distance from its middle."""
    rotation_deg: float
    """Median deviation of its orientation."""
    depth: float
    """Median relative deviation of depths."""


def verdict(trajectory: Trajectory, keyframes: Trajectory, known: Uncertainty) -> Verdict:
    """Whether trajectory and shape are to be relied on.

    Args:
        trajectory: of all frames.
        keyframes: of the keyframes alone.
        known: how well these are known.
    """
    places = keyframes.T_wc[:, :3, 3]
    extent = float(np.sqrt(np.square(places - places.mean(0)).sum(1).mean())) if len(places) else 0
    lost = 1 - float(trajectory.tracked.mean()) if len(trajectory.tracked) else 1.0
    position = _median(known.position) / max(extent, 1e-12)
    depth, rotation = _median(known.depth), float(np.degrees(_median(known.rotation)))
    reasons = []
    if lost > MOST_LOST:
        reasons.append(f"the camera was lost in {lost:.0%} of the frames")
    if not position <= MOST_OFF:
        reasons.append(f"its place is known only to {_share(position)} of the extent of its path")
    if not depth <= MOST_DEEP:
        reasons.append(f"depths are known only to {_share(depth)}")
    if reasons:
        sentence = f"Not to be relied on: {'; '.join(reasons)}."
    else:
        sentence = (
            f"Trajectory and shape are reliable: the camera's place is known to {position:.1%} of "
            f"the extent of its path, depths to {depth:.1%}."
        )
    return Verdict(not reasons, sentence, lost, position, rotation, depth)


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("inf")


def _share(value: float) -> str:
    return f"{value:.0%}" if value < 10 else "nothing"
