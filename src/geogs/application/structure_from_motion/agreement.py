"""Whether two ways to place the frames of a video turn its camera alike.

Where the camera is a start may mistake; how it turns from frame to frame hardly: a location that
was followed and checked against the images is right to a fraction of a degree, whatever became of
scale and drift. So a second way that turns otherwise, however well it knows itself, is wrong; and
one that turns much otherwise just between two frames joins its parts wrongly there.
"""

import numpy as np

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
"""Degrees by which a frame and the next may not turn otherwise, if those around them do as well: a
single frame in a wrong place is no joint."""


def turn_alike(first: Trajectory, second: Trajectory) -> bool:
    """Whether most pairs of frames are turned alike by both, or there are too few of them, and
    nowhere a frame and the next quite differently.

    Frames are known by their times; those count whose places both know.
    """
    known = first.of("tracked"), second.of("tracked")
    times, *rows = np.intersect1d(*(k.timestamps for k in known), return_indices=True)
    R = [k.T_wc[row, :3, :3] for k, row in zip(known, rows, strict=True)]
    number = np.searchsorted(first.timestamps, times)
    begin = np.flatnonzero(number[3:] - number[:-3] == 3)
    around = relative_rotation_error(R[1], R[0], begin, begin + 3)
    between = relative_rotation_error(R[1], R[0], begin + 1, begin + 2)
    if (np.minimum(around, between) > JOINT).any():
        return False
    begin = np.arange(len(R[0]) - APART)
    if len(begin) < FEWEST:
        return True
    apart = relative_rotation_error(R[1], R[0], begin, begin + APART)
    allowed = TOLERANCE + OF_TURN * rotation_angle(R[0][begin], R[0][begin + APART])
    return bool((apart <= allowed).mean() > 0.5)
