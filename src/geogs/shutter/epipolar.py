"""The motion between two views of a rigid scene, from matches."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

_PROBABILITY, _TRIES = 0.9999, 1000


@dataclass(frozen=True)
class RelativePose:
    """A motion of one view against another, up to the length of its translation."""

    R: Float[np.ndarray, "3 3"]
    """A point at X in the first view is at ``R X + t`` in the second."""
    t: Float[np.ndarray, "3"]
    """Its length is one."""


def relative_pose(
    first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"], tolerance: float
) -> RelativePose | None:
    """The motion that most matches agree on (MAGSAC, the same for the same matches).

    Args:
        first: x/z and y/z of the matches in the first view.
        second: in the second view.
        tolerance: error of an inlier, as a fraction of the focal length.
    """
    cv2.setRNGSeed(0)  # process-wide: OpenCV has no generator for one call
    E, inliers = cv2.findEssentialMat(
        first, second, np.eye(3), cv2.USAC_MAGSAC, _PROBABILITY, tolerance, _TRIES
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, first, second, np.eye(3), mask=inliers.copy())
    return RelativePose(R, t[:, 0] / np.linalg.norm(t))
