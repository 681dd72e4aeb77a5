"""Walls and ceiling of a room, which are in the way of those who look into it from outside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from geogs.evaluation.model_view.levelling import Facets

LEAST_AREA, MOST_BEYOND = 0.03, 0.03
"""Area of a wall, and of what is beyond it, as parts of all."""
FACES = 20.0
"""Degrees up to which a facet faces inwards."""
DEEP = (0.08, 0.08, 0.04)
"""What stands at a wall and goes with it, as a part of the room's extent; likewise the ceiling."""
_GROUND = 0.06
"""Part of the height up to which all stays: the floor."""
_KEPT = 0.005


@dataclass(frozen=True)
class Room:
    """Inside which nothing is in the way; coordinates along right, forward and up.

    Who is beyond one of these bounds looks through what is beyond it, too, but for the floor.
    """

    low: Float[np.ndarray, "3"]
    """Minus infinity where there is no wall."""
    high: Float[np.ndarray, "3"]
    """Infinity where there is no wall, or no ceiling."""
    ground: float
    """Height up to which all stays."""


def find_room(
    surface: Facets, axes: Float[np.ndarray, "3 3"], T_wc: Float[np.ndarray, "k 4 4"]
) -> Room:
    """The sides of a surface, in level axes, on which there is a wall or a ceiling.

    That is area which faces inwards, lies beyond most of the cameras, and has little beyond it.
    """
    local, normals = surface.centres @ axes.T, surface.normals @ axes.T
    cameras = np.median(T_wc[:, :3, 3] @ axes.T, axis=0)
    low, high = np.quantile(local, [_KEPT, 1 - _KEPT], axis=0)
    extent = high - low
    bounds = np.full((2, 3), np.inf)
    for axis, sign in ((0, 1), (1, 1), (2, 1), (0, -1), (1, -1)):
        along, facing = sign * local[:, axis], sign * normals[:, axis]
        place = _wall(along, facing, surface.areas, sign * cameras[axis], extent[axis])
        if place is not None:
            bounds[(1 - sign) // 2, axis] = place - DEEP[axis] * extent[axis]
    return Room(-bounds[1], bounds[0], float(low[2] + _GROUND * extent[2]))


def _wall(
    along: Float[np.ndarray, "m"],
    facing: Float[np.ndarray, "m"],
    areas: Float[np.ndarray, "m"],
    camera: float,
    extent: float,
) -> float | None:
    """Where, along a direction, the wall is that faces against it."""
    is_wall = (facing < -np.cos(np.radians(FACES))) & (along > camera)
    if not areas[is_wall].sum() > LEAST_AREA * areas.sum():
        return None
    order = np.argsort(along[is_wall])
    summed = areas[is_wall][order].cumsum()
    place = float(along[is_wall][order][summed.searchsorted(summed[-1] / 2)])
    beyond = areas[along > place + 0.05 * extent].sum()
    return place if beyond < MOST_BEYOND * areas.sum() else None
