"""How well matches between two views obey an essential matrix, and how that changes."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from geogs.shutter.turning import cross, rotated

_PROBABILITY, _TRIES = 0.9999, 1000


@dataclass(frozen=True)
class RelativePose:
    """A motion of one view against another, up to the length of its translation."""

    R: Float[np.ndarray, "3 3"]
    """A point at X in the first view is at ``R X + t`` in the second."""
    t: Float[np.ndarray, "3"]
    """Of length one."""

    def stepped(self, step: Float[np.ndarray, "5"]) -> "RelativePose":
        """After a rotation of ``step[:3]`` on the left, and ``t`` moved along its tangents."""
        columns = rotated(self.R.T, np.repeat(step[None, :3], 3, axis=0))
        t = self.t + self._tangents @ step[3:]
        return RelativePose(columns.T, t / np.linalg.norm(t))

    def errors(
        self, first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n"]:
        """Sampson's errors of matches, signed, as a share of the focal length.

        Args:
            first: x/z and y/z in the first view.
            second: in the second.
        """
        return self._products(first, second)[0]

    def derivatives(
        self, first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n 5"]:
        """Those of the errors by :meth:`stepped`'s step, the denominator of the error held."""
        _, scale, b, turned = self._products(first, second)
        # b . (t x Exp(phi) c): derivatives by phi and by t, c being the turned ray.
        by_rotation = cross(turned, cross(b, self.t[None]))
        by_translation = cross(turned, b) @ self._tangents
        return np.concatenate([by_rotation, by_translation], axis=1) * scale[:, None]

    def _products(
        self, first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"]
    ) -> tuple[
        Float[np.ndarray, "n"],
        Float[np.ndarray, "n"],
        Float[np.ndarray, "n 3"],
        Float[np.ndarray, "n 3"],
    ]:
        """Errors, what ``b . E a`` was multiplied by for them, the rays b, and R a."""
        a, b = (np.concatenate([p, np.ones((len(p), 1))], axis=1) for p in (first, second))
        turned, t = a @ self.R.T, self.t[None]
        line = cross(t, turned)  # E a
        back = cross(b, t) @ self.R  # E^T b
        squares = (line[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
        scale = 1 / np.sqrt(np.maximum(squares, 1e-12))
        return (b * line).sum(1) * scale, scale, b, turned

    @property
    def _tangents(self) -> Float[np.ndarray, "3 2"]:
        """Two unit vectors at right angles to ``t`` and to each other."""
        one = np.cross(self.t, np.eye(3)[np.abs(self.t).argmin()])
        one /= np.linalg.norm(one)
        return np.stack([one, np.cross(self.t, one)], axis=1)


def relative_pose(
    first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"], tolerance: float
) -> RelativePose | None:
    """The motion that most matches agree on (MAGSAC, the same for the same matches).

    Args:
        first: x/z and y/z of the matches in the first view.
        second: in the second view.
        tolerance: error of an inlier, as a share of the focal length.
    """
    cv2.setRNGSeed(0)
    E, inliers = cv2.findEssentialMat(
        first, second, np.eye(3), cv2.USAC_MAGSAC, _PROBABILITY, tolerance, _TRIES
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, first, second, np.eye(3), mask=inliers.copy())
    return RelativePose(R, t[:, 0] / np.linalg.norm(t))
