"""Whether two ways to place the frames of a video turn its camera alike.

Where the camera is a start may mistake; how it turns from frame to frame hardly: a location that
was followed and checked against the images is right to a fraction of a degree, whatever became of
scale and drift. So a second way that turns otherwise, however well it knows itself, is wrong; and
one that turns much otherwise just between two frames joins its parts wrongly there.
"""

import numpy as np
from jaxtyping import Float64

from geogs.evaluation.rotation_errors import relative_rotation_error, rotation_angle
from geogs.types import Trajectory

APART = 5
"""Frames, of those that both place, from the first to the second of a pair."""
FEWEST = 10
"""Pairs below which nothing can be said."""
TOLERANCE = 1.0
"""Degrees by which the turns of a pair may differ, ..."""
OF_TURN = 0.15
"""... and part of the turn: focal lengths that differ so much turn so differently."""
JOINT = 30.0
"""Degrees by which no two frames that follow one another may turn otherwise."""


def turn_alike(first: Trajectory, second: Trajectory) -> bool:
    """Whether most pairs of frames are turned alike by both, or there are too few of them.

    Frames are known by their times; those count whose places both know.
    """
    known = first.of("tracked"), second.of("tracked")
    _, R = _common(*known)
    begin = np.arange(len(R[0]) - APART)
    if len(begin) < FEWEST:
        return True
    apart = relative_rotation_error(R[1], R[0], begin, begin + APART)
    allowed = TOLERANCE + OF_TURN * rotation_angle(R[0][begin], R[0][begin + APART])
    return bool((apart <= allowed).mean() > 0.5)


def is_joined_otherwise(tracked: Trajectory, sharp: Trajectory) -> bool:
    """Whether two sharp frames, of which the second is the next, are turned quite otherwise than
    tracking, which lost none between them, saw it."""
    times, R = _common(tracked.of("tracked"), sharp)
    number = np.searchsorted(tracked.timestamps, times)
    lost = np.cumsum([state != "tracked" for state in tracked.states])[number]
    begin = np.flatnonzero(np.diff(lost) == 0)
    return bool((relative_rotation_error(R[1], R[0], begin, begin + 1) > JOINT).any())


def _common(
    first: Trajectory, second: Trajectory
) -> tuple[Float64[np.ndarray, "n"], list[Float64[np.ndarray, "n 3 3"]]]:
    """Times of the frames of both, and their orientations by each."""
    times, *rows = np.intersect1d(first.timestamps, second.timestamps, return_indices=True)
    return times, [k.T_wc[row, :3, :3] for k, row in zip((first, second), rows, strict=True)]
