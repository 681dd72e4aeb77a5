"""Agreement of two trajectories of a video in the camera's rotation.

A wrong initialisation may misplace the camera, but hardly its rotation between frames: tracked
rotations that were checked against the images are right to a fraction of a degree, regardless of
scale and drift. So a second trajectory with other rotations is wrong, however small its standard
deviations; and one that differs just between two frames joins its parts wrongly there.
"""

import numpy as np
from jaxtyping import Float64

from geogs.evaluation.rotation_errors import relative_rotation_error, rotation_angle
from geogs.types import Trajectory

FRAMES_APART = 5
"""Distance of the frames of a pair, counted in frames located by both trajectories."""
MIN_PAIRS = 10
"""Least number of pairs for a test."""
MAX_DIFFERENCE_DEG = 1.0
"""Largest difference of a pair's rotations in degrees, plus ..."""
MAX_RELATIVE_DIFFERENCE = 0.15
"""... this fraction of the rotation: wrong focal lengths scale it by that much."""
MAX_JOINT_DEG = 30.0
"""Largest difference of the rotations between two consecutive frames in degrees."""


def rotations_agree(first: Trajectory, second: Trajectory) -> bool:
    """Whether the rotations of most frame pairs agree, or there are too few pairs.

    Frames are matched by their times; those count that both trajectories located.
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
    """Whether the rotation between two consecutive sharp frames differs much from tracking, which
    lost no frame between them."""
    times, R = _common(tracked.of("tracked"), sharp)
    number = np.searchsorted(tracked.timestamps, times)
    lost = np.cumsum([state != "tracked" for state in tracked.states])[number]
    begin = np.flatnonzero(np.diff(lost) == 0)
    return bool((relative_rotation_error(R[1], R[0], begin, begin + 1) > MAX_JOINT_DEG).any())


def _common(
    first: Trajectory, second: Trajectory
) -> tuple[Float64[np.ndarray, "n"], list[Float64[np.ndarray, "n 3 3"]]]:
    """Times of the common frames, and their orientations by each trajectory."""
    times, *rows = np.intersect1d(first.timestamps, second.timestamps, return_indices=True)
    return times, [k.T_wc[row, :3, :3] for k, row in zip((first, second), rows, strict=True)]
