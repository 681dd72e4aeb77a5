"""The part of a result that is exported: inside a box, or near the camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from geogs.errors import InputError


@dataclass(frozen=True)
class Region:
    """A box in the upright world, or all within a distance of the camera's positions."""

    low: Float[np.ndarray, "3"]
    """Least coordinates: right, forward, up."""
    high: Float[np.ndarray, "3"]
    near: float = np.inf
    """Largest distance from the nearest position of the camera."""

    def holds(
        self,
        points: Float[np.ndarray, "n 3"],
        axes: Float[np.ndarray, "3 3"],
        cameras: Float[np.ndarray, "k 3"],
    ) -> Bool[np.ndarray, "n"]:
        """Which points of a world lie inside.

        Args:
            points: the points.
            axes: rows right, forward and up of that world.
            cameras: positions of the camera in it.
        """
        local = points.astype(np.float64) @ axes.T
        inside = ((local >= self.low) & (local <= self.high)).all(1)
        if self.near < np.inf:
            from scipy.spatial import cKDTree

            distance, _ = cKDTree(cameras).query(points, distance_upper_bound=self.near)
            inside &= distance <= self.near
        return np.asarray(inside)


def read_region(text: str) -> Region | None:
    """Read ``x0,y0,z0,x1,y1,z1`` or ``near:DISTANCE``; none where the text is empty.

    Raises:
        InputError: it is neither.
    """
    if not text:
        return None
    word, _, rest = text.rpartition(":")
    try:
        numbers = np.array([float(n) for n in rest.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if word == "near" and numbers.shape == (1,) and numbers[0] > 0:
        return Region(np.full(3, -np.inf), np.full(3, np.inf), float(numbers[0]))
    if not word and numbers.shape == (6,) and (numbers[:3] < numbers[3:]).all():
        return Region(numbers[:3], numbers[3:])
    raise InputError(
        f"--crop {text}: give x0,y0,z0,x1,y1,z1 with each first number below its second "
        "(right, forward, up), or near:DISTANCE from the camera."
    )
