"""Straight walls in a cut through a room: which of its lines they are, their ends and lengths."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from geogs.mesh.drawing.cut import Cut

OFF, GAP, SHORTEST = 1 / 200, 1 / 20, 1 / 15
"""Largest distance of a line from its wall, largest gap within a wall or at a corner, and least
length of a wall, all as fractions of the cut's extent."""
TURNED = 35.0
"""Largest angle between a line and its wall, degrees: surfaces are rough."""
_DIRECTIONS = 180
"""Tested directions of walls, over the whole turn."""


@dataclass(frozen=True)
class Walls:
    """Straight walls of a cut."""

    ends: Float[np.ndarray, "w 2 2"]
    """Both ends of each wall."""
    inward: Float[np.ndarray, "w 2"]
    """Unit normals towards free space."""
    others: Cut
    """Lines that belong to no wall."""

    @property
    def lengths(self) -> Float[np.ndarray, "w"]:
        """Lengths of the walls."""
        return np.asarray(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1))


def find_walls(cut: Cut) -> Walls:
    """Find the straight walls of a cut, longest first, and join them at corners.

    The direction and distance with most lines are found by a Hough transform and refined by least
    squares; the lines on it are split at gaps, and so on with the other lines.
    """
    extent = float(np.linalg.norm(np.ptp(cut.ends.reshape(-1, 2), axis=0))) if len(cut.ends) else 0
    middles = cut.ends.mean(1)
    left = np.ones(len(cut.ends), bool)
    is_wall = np.zeros(len(cut.ends), bool)
    walls: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    while left.any():
        support, normal, distance = _best(cut, middles, left, OFF * extent)
        if support < SHORTEST * extent:
            break
        for _ in range(3):
            on = _on(cut, middles, left, normal, distance, OFF * extent)
            normal, distance = _fitted(cut, middles, on, normal)
        for run in _runs(cut, np.flatnonzero(on), normal, extent):
            is_wall[run] = True
            walls.append(_ends(cut.ends[run].reshape(-1, 2), normal, distance))
            normals.append(normal)
        if not on.any():
            break
        left &= ~on
    ends = np.array(walls).reshape(-1, 2, 2)
    inward = np.array(normals).reshape(-1, 2)
    order = np.argsort(-np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), kind="stable")
    joined = _joined(ends[order], inward[order], GAP * extent)
    return Walls(joined, inward[order], cut.part(~is_wall))


def _best(
    cut: Cut, middles: Float[np.ndarray, "k 2"], left: Bool[np.ndarray, "k"], off: float
) -> tuple[float, Float[np.ndarray, "2"], float]:
    """Length on the best supported line, its normal, and its distance from the origin."""
    angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    normals = np.stack([np.cos(angles), np.sin(angles)], 1)
    cosine = cut.inward[left] @ normals.T
    weight = np.where(cosine > np.cos(np.radians(TURNED)), cosine, 0) * cut.lengths[left][:, None]
    cell = np.floor(middles[left] @ normals.T / (2 * off)).astype(np.int64)
    cell -= cell.min()
    size = int(cell.max()) + 2
    votes = np.bincount(
        (cell + size * np.arange(_DIRECTIONS)).ravel(), weight.ravel(), size * _DIRECTIONS
    ).reshape(_DIRECTIONS, size)
    both = votes[:, :-1] + votes[:, 1:]
    direction, lower = np.unravel_index(both.argmax(), both.shape)
    near = (cell[:, direction] == lower) | (cell[:, direction] == lower + 1)
    chosen = weight[:, direction] * near
    distance = chosen @ (middles[left] @ normals[direction]) / max(chosen.sum(), 1e-300)
    return float(both.max()), normals[direction], float(distance)


def _on(
    cut: Cut,
    middles: Float[np.ndarray, "k 2"],
    left: Bool[np.ndarray, "k"],
    normal: Float[np.ndarray, "2"],
    distance: float,
    off: float,
) -> Bool[np.ndarray, "k"]:
    """Lines that lie on a wall and face as it does."""
    faces = cut.inward @ normal > np.cos(np.radians(TURNED))
    return left & faces & (np.abs(middles @ normal - distance) < 2 * off)


def _fitted(
    cut: Cut,
    middles: Float[np.ndarray, "k 2"],
    on: Bool[np.ndarray, "k"],
    normal: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "2"], float]:
    """Normal and distance of the line through some lines by least squares, by their lengths."""
    weight = cut.lengths[on]
    if not weight.sum() > 0:
        return normal, 0.0
    centre = weight @ middles[on] / weight.sum()
    points = cut.ends[on].reshape(-1, 2) - centre
    spread = (points.T * weight.repeat(2)) @ points
    across = np.linalg.eigh(spread)[1][:, 0]
    across = across * (np.sign(across @ normal) or 1.0)
    if across @ normal < np.cos(np.radians(TURNED)):  # too short to tell
        across = normal
    return across, float(across @ centre)


def _runs(
    cut: Cut, on: Int[np.ndarray, "k"], normal: Float[np.ndarray, "2"], extent: float
) -> list[Int[np.ndarray, "m"]]:
    """The lines of each wall on one line: without large gaps, long and covered enough."""
    if not len(on):
        return []
    along = np.sort(cut.ends[on] @ [-normal[1], normal[0]], axis=1)
    order = np.argsort(along[:, 0], kind="stable")
    reached = np.maximum.accumulate(along[order, 1])
    starts = np.flatnonzero(along[order[1:], 0] - reached[:-1] > GAP * extent) + 1
    runs = []
    for part in np.split(order, starts):
        length = float(along[part, 1].max() - along[part, 0].min())
        covered = float((along[part, 1] - along[part, 0]).sum())
        if length > SHORTEST * extent and covered > 0.6 * length:
            runs.append(on[part])
    return runs


def _ends(
    points: Float[np.ndarray, "m 2"], normal: Float[np.ndarray, "2"], distance: float
) -> Float[np.ndarray, "2 2"]:
    """Ends of a wall: those of its lines, moved onto it."""
    direction = np.array([-normal[1], normal[0]])
    along = points @ direction
    return distance * normal + np.outer([along.min(), along.max()], direction)


def _joined(
    ends: Float[np.ndarray, "w 2 2"], inward: Float[np.ndarray, "w 2"], gap: float
) -> Float[np.ndarray, "w 2 2"]:
    """Walls that begin and end where they meet others, if these are within the gap."""
    joined = ends.copy()
    distances = (ends[:, 0] * inward).sum(1)
    for number, wall in enumerate(ends):
        for other in range(len(ends)):
            lines = inward[[number, other]]
            if abs(np.linalg.det(lines)) < 0.3:  # they are nearly parallel
                continue
            corner = np.linalg.solve(lines, distances[[number, other]])
            if _beyond(corner, ends[other]) > gap:
                continue
            end = int(np.argmin(np.linalg.norm(wall - corner, axis=1)))
            moved = np.linalg.norm(joined[number, end] - wall[end]) or np.inf
            if np.linalg.norm(wall[end] - corner) < min(gap, moved):
                joined[number, end] = corner
    return joined


def _beyond(point: Float[np.ndarray, "2"], wall: Float[np.ndarray, "2 2"]) -> float:
    """How far a point on the line of a wall lies beyond its ends; 0 between them."""
    along = wall[1] - wall[0]
    length = float(np.linalg.norm(along))
    place = float((point - wall[0]) @ along) / length
    return max(-place, place - length, 0.0)
