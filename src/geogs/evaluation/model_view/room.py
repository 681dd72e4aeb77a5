"""Walls and ceiling of a room, which occlude a view into it from outside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from geogs.evaluation.model_view.levelling import Facets

LEAST_AREA, MOST_BEYOND = 0.03, 0.03
"""Least area of a wall, and largest area beyond it, as fractions of the whole area."""
FACES = 20.0
"""Largest angle to the inward direction for a facet to face inwards, degrees."""
DEEP = (0.08, 0.08, 0.04)
"""Depth of objects at a wall, or ceiling, that are hidden with it, relative to the extent."""
_GROUND = 0.06
"""Fraction of the height that is always shown: the floor."""


@dataclass(frozen=True)
class Room:
    """Box inside which nothing occludes; coordinates along right, forward and up.

    A viewer beyond one of these bounds sees through everything beyond it, except the floor.
    """

    low: Float[np.ndarray, "3"]
    """Minus infinity where there is no wall."""
    high: Float[np.ndarray, "3"]
    """Infinity where there is no wall, or no ceiling."""
    ground: float
    """Height up to which everything is shown."""


def find_room(
    surface: Facets, axes: Float[np.ndarray, "3 3"], T_wc: Float[np.ndarray, "k 4 4"]
) -> Room:
    """Find the sides of a surface, in level axes, with a wall or a ceiling.

    A wall is area that faces inwards, lies beyond all cameras, and has little beyond it. Nothing is
    hidden from a viewer at one of the cameras: in a corridor, they are near to walls.
    """
    local = surface.centres @ axes.T
    normals = surface.normals @ axes.T
    cameras = T_wc[:, :3, 3] @ axes.T
    low, high = np.quantile(local, [0.005, 0.995], axis=0)
    extent = high - low
    bounds = np.full((2, 3), np.inf)
    for axis, sign in ((0, 1), (1, 1), (2, 1), (0, -1), (1, -1)):
        along = sign * local[:, axis]
        facing = sign * normals[:, axis]
        farthest = float((sign * cameras[:, axis]).max())
        place = _wall(along, facing, surface.areas, farthest, extent[axis])
        if place is not None:
            bound = max(place - DEEP[axis] * extent[axis], farthest)
            bounds[(1 - sign) // 2, axis] = bound
    return Room(-bounds[1], bounds[0], float(low[2] + _GROUND * extent[2]))


def _wall(
    along: Float[np.ndarray, "m"],
    facing: Float[np.ndarray, "m"],
    areas: Float[np.ndarray, "m"],
    camera: float,
    extent: float,
) -> float | None:
    """Coordinate, along a direction, of the wall that faces against it; none without one."""
    is_wall = (facing < -np.cos(np.radians(FACES))) & (along > camera)
    if not areas[is_wall].sum() > LEAST_AREA * areas.sum():
        return None
    order = np.argsort(along[is_wall])
    summed = areas[is_wall][order].cumsum()
    place = float(along[is_wall][order][summed.searchsorted(summed[-1] / 2)])
    beyond = areas[along > place + 0.05 * extent].sum()
    return place if beyond < MOST_BEYOND * areas.sum() else None
