"""Up direction of a reconstruction, by its planes and by the camera's orientation."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from geogs.evaluation.held_camera import level_axes

FARTHEST = 55.0
"""Largest angle between up and the camera's mean up, degrees."""
AGREES = 5.0
"""Largest tilt of a surface that counts as level or upright, degrees."""
LEAST_SHARE = 0.18
"""Least fraction of the area that must agree; for a ball it is 9 %."""
LEAST_WALLS = 0.25
"""Least length of the mean of walls' quadrupled azimuths for a rectangular room."""
_STEP, _WIDTH = 2.5, 4.0
"""Degrees between the tested directions, and the standard deviation of a vote."""
_PARTS = 32
"""Quantisation of normals, in steps per unit; facets of equal normals vote together."""
_UPRIGHT = 0.5
"""Weight of upright area relative to level area."""
_HELD, _HELD_WIDTH = 0.1, 20.0
"""Weight of the camera's vote relative to the whole area, and its standard deviation in degrees."""
_FIRM = 1e-3
"""The same weight in the refinement: it decides only directions that planes do not determine."""


class Facets(NamedTuple):
    """Triangles, as centres, normals and areas."""

    centres: Float[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 3"]
    """Unit, towards free space; smooth where those of the vertices are."""
    areas: Float[np.ndarray, "m"]


@dataclass(frozen=True)
class Level:
    """Upright orientation of a reconstruction."""

    axes: Float[np.ndarray, "3 3"]
    """Rows right, forward, up in the world; right runs along the walls of a rectangular room."""
    share: float | None
    """Fraction of the surface that is level or upright; none where the camera alone decided."""

    @property
    def y_down(self) -> Float[np.ndarray, "3 3"]:
        """The same axes as rows right, down, forward: those of a level camera."""
        right, forward, up = self.axes
        return np.stack([right, -up, forward])


def facets(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
) -> Facets:
    """Triangles of a mesh with the means of their corners' normals."""
    corners = vertices.astype(np.float64)[faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return Facets(corners.mean(1), _unit(normals[faces].astype(np.float64).sum(1)), areas / 2)


def level(surface: Facets | None, T_wc: Float[np.ndarray, "k 4 4"]) -> Level:
    """Find upright axes of a surface: floors, ceilings and table tops level, walls vertical.

    Each facet votes with its area for the directions along its normal and, half as much, for those
    perpendicular to it; the best within 55 degrees of the camera's mean up is refined by least
    squares. Where less than 18 % of the area agree, as on a plant, the camera decides alone.
    """
    held = level_axes(T_wc)
    if surface is None or not surface.areas.sum() > 0:
        return Level(held, None)
    normals, weights = _together(surface)
    up = _refined(normals, weights, _best(normals, weights, held[2]), held[2])
    share = float(weights[_off(normals @ up) < np.sin(np.radians(AGREES))].sum())
    if share < LEAST_SHARE:
        return Level(held, None)
    return Level(_along_walls(normals, weights, level_axes(T_wc, up)), share)


def _together(surface: Facets) -> tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b"]]:
    """Mean normals of facets with equal quantised normals, and their fractions of the area."""
    cells = np.rint(_PARTS * surface.normals).astype(np.int64) @ np.array([10_000, 100, 1])
    _, group = np.unique(cells, return_inverse=True)
    sums = [
        np.bincount(group, surface.areas * values)
        for values in (*surface.normals.T, np.ones(len(group)))
    ]
    return _unit(np.stack(sums[:3], 1)), sums[3] / sums[3].sum()


def _best(
    normals: Float[np.ndarray, "b 3"], weights: Float[np.ndarray, "b"], held: np.ndarray
) -> Float[np.ndarray, "3"]:
    """The direction with most votes, of those on rings around the camera's up."""
    side = _unit(np.cross(held, np.eye(3)[np.abs(held).argmin()]))
    rings = [held[None]]
    for tilt in np.radians(np.arange(_STEP, FARTHEST, _STEP)):
        turns = np.arange(0, 2 * np.pi, np.radians(_STEP) / np.sin(tilt))[:, None]
        around = np.cos(turns) * side + np.sin(turns) * np.cross(held, side)
        rings.append(np.cos(tilt) * held + np.sin(tilt) * around)
    tried = np.concatenate(rings)
    own = _HELD * _vote(np.arccos(np.clip(tried @ held, -1, 1)), _HELD_WIDTH)
    votes = [weights @ _votes(normals @ up) for up in tried]
    return np.asarray(tried[int(np.argmax(votes + own))])


def _refined(
    normals: Float[np.ndarray, "b 3"],
    weights: Float[np.ndarray, "b"],
    up: np.ndarray,
    held: np.ndarray,
) -> Float[np.ndarray, "3"]:
    """Least squares over agreeing facets: (n·up)² of walls, 1 - (n·up)² of floors."""
    for _ in range(10):
        cosine = normals @ up
        shares = weights * _votes(cosine) * np.where(np.abs(cosine) > 0.7, -1.0, 1.0)
        spread = (normals.T * shares) @ normals - _FIRM * np.outer(held, held)
        up = np.linalg.eigh(spread)[1][:, 0]
        up *= np.sign(up @ held) or 1.0
    return up


def _along_walls(
    normals: Float[np.ndarray, "b 3"], weights: Float[np.ndarray, "b"], axes: np.ndarray
) -> Float[np.ndarray, "3 3"]:
    """Rotate axes about up to align with the walls, by less than 45 degrees."""
    east, north, high = (normals @ axis for axis in axes)
    walls = weights * (np.abs(high) < np.sin(np.radians(2 * AGREES)))
    mean = (walls * np.exp(4j * np.arctan2(north, east))).sum() / max(walls.sum(), 1e-12)
    if abs(mean) < LEAST_WALLS:
        return axes
    turn = np.angle(mean) / 4
    right = np.cos(turn) * axes[0] + np.sin(turn) * axes[1]
    return np.stack([right, np.cross(axes[2], right), axes[2]])


def _votes(cosine: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b"]:
    """Votes of normals for a direction, by their cosines to it."""
    is_level = np.abs(cosine) > 0.7
    return np.where(is_level, 1.0, _UPRIGHT) * _vote(np.arcsin(_off(cosine).clip(0, 1)), _WIDTH)


def _off(cosine: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b"]:
    """Sine of the angle to level or to upright, whichever is nearer."""
    return np.minimum(np.abs(cosine), np.sqrt((1 - cosine**2).clip(0, 1)))


def _vote(angle: np.ndarray, degrees: float) -> np.ndarray:
    return np.exp(-0.5 * (np.degrees(angle) / degrees) ** 2)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)
