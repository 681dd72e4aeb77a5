"""Whether two trajectories of a video agree in how its camera rotates.

A wrong start may misplace the camera, but hardly its rotation from frame to frame: what was tracked
and checked against the images is right to a fraction of a degree, whatever became of scale and
drift. So a second trajectory that rotates otherwise is wrong, however small its deviations; and one
that does so just between two frames joins its parts wrongly there.
"""

import numpy as np
from jaxtyping import Float64

from geogs.evaluation.rotation_errors import relative_rotation_error, rotation_angle
from geogs.types import Trajectory

FRAMES_APART = 5
"""Frames, of those that both place, from the first to the second of a pair."""
MIN_PAIRS = 10
"""Pairs below which nothing can be said."""
MAX_DIFFERENCE_DEG = 1.0
"""Degrees by which the rotations of a pair may differ, ..."""
MAX_RELATIVE_DIFFERENCE = 0.15
"""... and fraction of the rotation: by so much do wrong focal lengths scale it."""
MAX_JOINT_DEG = 30.0
"""Degrees by which the rotation between two frames in a row may differ at most."""


def rotations_agree(first: Trajectory, second: Trajectory) -> bool:
    """Whether most pairs of frames are rotated alike by both, or there are too few of them.

    Frames are known by their times; those count whose places both know.
    """
    known = first.of("tracked"), second.of("tracked")
    _, R = _common(*known)
    begin = np.arange(len(R[0]) - FRAMES_APART)
    if len(begin) < MIN_PAIRS:
        return True
    end = begin + FRAMES_APART
    difference = relative_rotation_error(R[1], R[0], begin, end)
    angle = rotation_angle(R[0][begin], R[0][end])
    return bool((difference <= MAX_DIFFERENCE_DEG + MAX_RELATIVE_DIFFERENCE * angle).mean() > 0.5)


def has_wrong_joint(tracked: Trajectory, sharp: Trajectory) -> bool:
    """Whether two sharp frames in a row are rotated quite otherwise than by tracking, which lost
    no frame between them."""
    times, R = _common(tracked.of("tracked"), sharp)
    number = np.searchsorted(tracked.timestamps, times)
    lost = np.cumsum([state != "tracked" for state in tracked.states])[number]
    begin = np.flatnonzero(np.diff(lost) == 0)
    return bool((relative_rotation_error(R[1], R[0], begin, begin + 1) > MAX_JOINT_DEG).any())


def _common(
    first: Trajectory, second: Trajectory
) -> tuple[Float64[np.ndarray, "n"], list[Float64[np.ndarray, "n 3 3"]]]:
    """Times of the frames of both, and their orientations by each."""
    times, *rows = np.intersect1d(first.timestamps, second.timestamps, return_indices=True)
    return times, [k.T_wc[row, :3, :3] for k, row in zip((first, second), rows, strict=True)]
