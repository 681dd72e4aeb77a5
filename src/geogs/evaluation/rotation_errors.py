"""Rotation errors: of aligned orientations, or relative between poses."""

import numpy as np
from jaxtyping import Float, Int

from geogs.geometry.nearest_rotation import nearest_rotation


def rotation_angle(
    a: Float[np.ndarray, "n 3 3"], b: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n"]:
    """Angle between rotations in degrees; accurate near zero, where arccos of the trace is not."""
    chord = np.linalg.norm(a - b, axis=(1, 2)) / 8**0.5
    return np.degrees(2 * np.arcsin(np.clip(chord, 0, 1)))


def best_rotation(
    estimate: Float[np.ndarray, "n 3 3"], reference: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "3 3"]:
    """World rotation that best aligns the estimated orientations to the reference."""
    return nearest_rotation((reference @ estimate.transpose(0, 2, 1)).sum(0))


def stretches(
    along: Float[np.ndarray, "n"], length: float
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """First and last poses of all stretches of the path of ``length``.

    ``along`` is the length of the path up to each pose, ascending. A stretch begins at each pose
    with enough of the path after it.
    """
    last = np.searchsorted(along, along + length * (1 - 1e-9))
    first = np.flatnonzero(last < len(along))
    return first, last[first]


def relative_rotation_error(
    estimate: Float[np.ndarray, "n 3 3"],
    truth: Float[np.ndarray, "n 3 3"],
    first: Int[np.ndarray, "m"],
    last: Int[np.ndarray, "m"],
) -> Float[np.ndarray, "m"]:
    """Angle in degrees between the estimated and the true rotation from ``first`` to ``last``.

    It is the rotation of the relative pose error (RPE; Sturm et al. 2012), which does not depend on
    the alignment of the trajectories.
    """
    found, true = (R[first].transpose(0, 2, 1) @ R[last] for R in (estimate, truth))
    return rotation_angle(found, true)
