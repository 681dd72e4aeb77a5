"""Whether two ways to place the frames of a video turn its camera alike.

Where the camera is a start may mistake; how it turns from frame to frame hardly: a location that
was followed and checked against the images is right to a fraction of a degree, whatever became of
scale and drift. So a second way that turns otherwise, however well it knows itself, is wrong.
"""

import numpy as np
from jaxtyping import Float

from geogs.types import Trajectory

APART = 5
"""Frames, of those that both place, from the first to the second of a pair."""
FEWEST = 10
"""Pairs below which nothing can be said."""
TOLERANCE = 1.0
"""Degrees by which the turns of a pair may differ, ..."""
OF_TURN = 0.15
"""... and part of the turn: focal lengths that differ so much turn so differently."""


def turn_alike(first: Trajectory, second: Trajectory) -> bool:
    """Whether most pairs of frames are turned alike by both, or there are too few of them.

    Frames are known by their times; those count whose places both know.
    """
    known = first.of("tracked"), second.of("tracked")
    times = [k.timestamps for k in known]
    _, *rows = np.intersect1d(times[0], times[1], return_indices=True)
    turns = [_turns(k.T_wc[row, :3, :3]) for k, row in zip(known, rows, strict=True)]
    if len(turns[0]) < FEWEST:
        return True
    apart = _degrees(turns[0].swapaxes(1, 2) @ turns[1])
    allowed = TOLERANCE + OF_TURN * _degrees(turns[0])
    return bool((apart <= allowed).mean() > 0.5)


def _turns(R_wc: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "m 3 3"]:
    """Rotation from each frame to the one that is so many later, in the axes of the first."""
    return R_wc[:-APART].swapaxes(1, 2) @ R_wc[APART:]


def _degrees(R: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m"]:
    """Angles of rotations."""
    return np.degrees(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1)))
