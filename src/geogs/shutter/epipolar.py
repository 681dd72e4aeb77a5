"""How well matches between two views obey an essential matrix, for several versions of the rays."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from geogs.shutter.turning import cross, rotated

ROUNDS = 8
_PROBABILITY, _TRIES = 0.9999, 3000


@dataclass(frozen=True)
class RelativePose:
    """A motion of one view against another, up to the length of its translation."""

    R: Float[np.ndarray, "3 3"]
    """A point at X in the first view is at ``R X + t`` in the second."""
    t: Float[np.ndarray, "3"]
    """Of length one."""


def relative_pose(
    first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"], tolerance: float
) -> RelativePose | None:
    """The motion that most matches agree on (MAGSAC, the same for the same matches).

    Args:
        first: rays of the matches in the first view.
        second: in the second view.
        tolerance: error of an inlier, as a share of the focal length.
    """
    a, b = (rays[:, :2] / rays[:, 2:] for rays in (first, second))
    cv2.setRNGSeed(0)
    E, inliers = cv2.findEssentialMat(
        a, b, np.eye(3), cv2.USAC_MAGSAC, _PROBABILITY, tolerance, _TRIES
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, a, b, np.eye(3), mask=inliers.copy())
    return RelativePose(R, t[:, 0] / np.linalg.norm(t))


def refined_costs(
    start: RelativePose,
    first: Float[np.ndarray, "k n 3"],
    second: Float[np.ndarray, "k n 3"],
    tolerance: float,
) -> Float[np.ndarray, "k"]:
    """The least robust cost of each of k versions of the same matches, near a motion.

    The cost of a match is Geman and McClure's ``e^2 / (1 + e^2)`` of its error by Sampson in units
    of the tolerance, that of a version their mean. Gauss-Newton steps on rotation and direction of
    translation, of iteratively reweighted matches, with the denominator of the error held.
    """
    versions = len(first)
    a, b = first / first[..., 2:], second / second[..., 2:]
    R = np.broadcast_to(start.R, (versions, 3, 3)).copy()
    t = np.broadcast_to(start.t, (versions, 3)).copy()
    best = np.full(versions, np.inf)
    for turn in range(ROUNDS + 1):
        turned = a @ R.transpose(0, 2, 1)
        error, scale = _sampson(R, t, b, turned)
        square = (error / tolerance) ** 2
        best = np.minimum(best, (square / (1 + square)).mean(1))
        if turn == ROUNDS:
            break
        # b . (t x Exp(phi) c): derivatives by phi and by t, c being the turned ray.
        by_rotation = cross(turned, cross(b, t[:, None]))
        basis = _tangents(t)
        by_translation = cross(turned, b) @ basis
        jacobian = np.concatenate([by_rotation, by_translation], 2) * scale[..., None]
        weighted = jacobian / (1 + square)[..., None] ** 2
        normal = weighted.transpose(0, 2, 1) @ jacobian
        damping = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
        right = -(weighted.transpose(0, 2, 1) @ error[..., None])
        step = np.linalg.solve(normal + damping * np.eye(5), right)[..., 0]
        R = _turned(R, step[:, :3])
        t = t + (basis @ step[:, 3:, None])[..., 0]
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
    return best


def _sampson(
    R: Float[np.ndarray, "k 3 3"],
    t: Float[np.ndarray, "k 3"],
    b: Float[np.ndarray, "k n 3"],
    turned: Float[np.ndarray, "k n 3"],
) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
    """Signed errors as a share of the focal length, and what the product was multiplied by."""
    line = cross(t[:, None], turned)  # E a
    back = cross(b, t[:, None]) @ R  # E^T b
    squares = (line[..., :2] ** 2).sum(2) + (back[..., :2] ** 2).sum(2)
    scale = 1 / np.sqrt(np.maximum(squares, 1e-12))
    return (b * line).sum(2) * scale, scale


def _tangents(t: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3 2"]:
    """Two unit vectors at right angles to each vector and to each other."""
    axis = np.eye(3)[np.abs(t).argmin(1)]
    one = cross(t, axis)
    one = one / np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, cross(t, one)], 2)


def _turned(
    R: Float[np.ndarray, "k 3 3"], by: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k 3 3"]:
    """``Exp(by) R``."""
    columns = R.transpose(0, 2, 1).reshape(-1, 3)
    turned = rotated(columns, np.repeat(by, 3, axis=0))
    return turned.reshape(-1, 3, 3).transpose(0, 2, 1)
