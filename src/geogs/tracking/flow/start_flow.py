"""Flow that is known at the cells of the grid, between them: by what the second image is warped.

Straight lines between cells are not enough. The flow of a plane that is seen at a slant, as of a
road, bends within the eight pixels from one cell to the next by up to a pixel, always to the same
side, and what is measured on top of it is a smooth flow, which takes the mean of that for motion:
along a street matches of the ground were too short by a tenth to a third of a pixel, and the scale
of the path drifted. So the interpolant is quadratic, in one step from linear, and stays linear
where the flow jumps or has a kink.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32

FARTHEST = 2.0
"""Cells beyond the border after which flow changes no further."""


class StartFlow:
    """An interpolant of flow on a grid of at least three by three cells.

    ``f(u, v) = linear + p(u) X + q(v) Y``. Between two cells, a being the share of the way from one
    to the next, p is -a (1 - a) / 2 and X a second difference along u, the smaller one of those at
    both ends, none if their signs differ (minmod): what is quadratic along either axis is exact,
    and a step never overshoots. Beyond the border, p is how far, and X the first difference
    there or one cell further in, whichever is smaller. Likewise Y along v. Source: the limited
    reconstructions of Harten et al. 1987 (ENO).
    """

    def __init__(self, flow: Float[np.ndarray, "r c 2"]) -> None:
        self._flow = np.ascontiguousarray(flow, np.float32)
        self._along_u, self._along_v = _bends(self._flow, 1), _bends(self._flow, 0)

    def on(self, lattice: "Lattice") -> Float32[np.ndarray, "h w 2"]:
        """At all places of a lattice that is made for such a grid."""
        x, height = lattice, len(lattice.u)
        found = _remap(self._flow, x.u, x.v)
        # Both numbers of a row behind each other: NumPy is slow on axes of two.
        flat = found.reshape(height, -1)
        flat += x.factor_u * _remap(self._along_u, x.interval_u, x.v).reshape(height, -1)
        flat += x.factor_v * _remap(self._along_v, x.u, x.interval_v).reshape(height, -1)
        return found

    def at(self, points: Float[np.ndarray, "p 2"]) -> Float32[np.ndarray, "p 2"]:
        """At some points, in cells."""
        rows, columns = self._flow.shape[:2]
        u, v = points.T.astype(np.float32)
        (i, p), (j, q) = _intervals(u, columns), _intervals(v, rows)
        i, j, p, q = i.astype(int), j.astype(int), p[:, None], q[:, None]
        (c, a), (r, b) = _cells(u, columns), _cells(v, rows)
        linear = (1 - b) * ((1 - a) * self._flow[r, c] + a * self._flow[r, c + 1])
        linear += b * ((1 - a) * self._flow[r + 1, c] + a * self._flow[r + 1, c + 1])
        along_u = (1 - b) * self._along_u[r, i] + b * self._along_u[r + 1, i]
        along_v = (1 - a) * self._along_v[j, c] + a * self._along_v[j, c + 1]
        return (linear + p * along_u + q * along_v).astype(np.float32)


class Lattice:
    """Columns u and rows v, in cells of a grid, with what interpolants at all of them need."""

    def __init__(
        self,
        u: Float32[np.ndarray, "w"],
        v: Float32[np.ndarray, "h"],
        rows: int,
        columns: int,
    ) -> None:
        """Places are multiples of 1/32, to which OpenCV rounds; the grid has so many cells."""
        self.u, self.v = np.meshgrid(u, v)
        interval, factor = _intervals(u, columns)
        self.interval_u, self.factor_u = np.meshgrid(interval, v)[0], factor.repeat(2)
        interval, factor = _intervals(v, rows)
        self.interval_v, self.factor_v = np.meshgrid(u, interval)[1], factor[:, None]


def _cells(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The cell before each place, and the share (p, 1) of the way to the next."""
    x = np.clip(x, 0, count - 1)
    cell = np.minimum(np.floor(x), count - 2).astype(int)
    return cell, (x - cell).astype(np.float32)[:, None]


def _intervals(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """In which interval between cells each place lies, and by what its bend is multiplied.

    That before the first cell is 0, that beyond the last one ``count``.
    """
    inside = np.clip(x, 0, count - 1)
    cell = np.minimum(np.floor(inside), count - 2)
    share, beyond = inside - cell, np.clip(x - inside, -FARTHEST, FARTHEST)
    interval = np.where(beyond < 0, 0, np.where(beyond > 0, count, cell + 1))
    factor = np.where(beyond != 0, beyond, -0.5 * share * (1 - share))
    return interval.astype(np.float32), factor.astype(np.float32)


def _bends(flow: Float32[np.ndarray, "r c 2"], axis: int) -> np.ndarray:
    """Of each interval along an axis: slope, second differences between cells, slope."""
    flow = np.moveaxis(flow, axis, 0)
    slope, second = np.diff(flow, 1, 0), np.diff(flow, 2, 0)
    # At the border the only one there is counts.
    ends = np.concatenate([second[:1], second, second[-1:]])
    between = _minmod(ends[:-1], ends[1:])
    left, right = _minmod(slope[:1], slope[1:2]), _minmod(slope[-1:], slope[-2:-1])
    found = np.concatenate([left, between, right])
    return np.ascontiguousarray(np.moveaxis(found, 0, axis))


def _minmod(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smaller one of two numbers of the same sign, else nothing."""
    return np.where(a * b > 0, np.where(np.abs(a) < np.abs(b), a, b), np.float32(0))


def _remap(field: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return cv2.remap(field, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
