"""Interpolation between the grid's cells of the known flow, by which the second image is warped.

Linear interpolation is not enough. The flow of a slanted plane, such as a road, is curved within
the eight pixels from one cell to the next, by up to a pixel and always to the same side. The flow
measured on top of it is smooth and would include the mean of that: along a street matches of the
ground were too short by a tenth to a third of a pixel, and the scale of the path drifted. So the
interpolant is quadratic, and stays linear where the flow jumps or has a kink.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32


class StartFlow:
    """An interpolant of flow on a grid of at least two by two cells.

    ``f(u, v) = linear - a (1 - a) / 2 X - b (1 - b) / 2 Y``, a and b being the fractions of the way
    from one cell to the next along u and v. X and Y are second differences along the two, each the
    smaller one of the cells at both ends, zero if their signs differ (minmod): it is exact for
    quadratics along either axis, and never overshoots at a step. Source: the limited
    reconstructions of Harten et al. 1987 (ENO).
    """

    def __init__(self, flow: Float[np.ndarray, "r c 2"]) -> None:
        self._flow = np.ascontiguousarray(flow, np.float32)
        self._bend_u, self._bend_v = _limited_bend(self._flow, 1), _limited_bend(self._flow, 0)

    def on(self, lattice: "Lattice") -> Float32[np.ndarray, "h w 2"]:
        """Interpolate at all points of a lattice made for this grid."""
        x, height = lattice, len(lattice.u)
        found = bilinear(self._flow, x.u, x.v)
        # Both components of a row in one axis: NumPy is slow on axes of two.
        flat = found.reshape(height, -1)
        flat -= x.factor_u * bilinear(self._bend_u, x.cell_u, x.v).reshape(height, -1)
        flat -= x.factor_v * bilinear(self._bend_v, x.u, x.cell_v).reshape(height, -1)
        return found

    def at(self, points: Float[np.ndarray, "p 2"]) -> Float32[np.ndarray, "p 2"]:
        """Interpolate at some points, in cells. The border is replicated."""
        rows, columns = self._flow.shape[:2]
        i, a = _cells(points[:, 0].astype(np.float32), columns)
        j, b = _cells(points[:, 1].astype(np.float32), rows)
        i, j, a, b = i.astype(int), j.astype(int), a[:, None], b[:, None]

        def along_u(field: np.ndarray, row: np.ndarray) -> np.ndarray:
            return (1 - a) * field[row, i] + a * field[row, i + 1]

        linear = (1 - b) * along_u(self._flow, j) + b * along_u(self._flow, j + 1)
        bend_u = (1 - b) * self._bend_u[j, i] + b * self._bend_u[j + 1, i]
        bend_v = along_u(self._bend_v, j)
        found: np.ndarray = linear - 0.5 * (a * (1 - a) * bend_u + b * (1 - b) * bend_v)
        return found


class Lattice:
    """Columns u and rows v, in cells of a grid, with precomputed data for interpolation."""

    def __init__(
        self,
        u: Float32[np.ndarray, "w"],
        v: Float32[np.ndarray, "h"],
        rows: int,
        columns: int,
    ) -> None:
        """Positions are multiples of 1/32, to which OpenCV rounds; ``rows``, ``columns``: cells."""
        self.u, self.v = np.meshgrid(u, v)
        cell, fraction = _cells(u, columns)
        self.cell_u = np.meshgrid(cell, v)[0]
        self.factor_u = (0.5 * fraction * (1 - fraction)).repeat(2)
        cell, fraction = _cells(v, rows)
        self.cell_v = np.meshgrid(u, cell)[1]
        self.factor_v = (0.5 * fraction * (1 - fraction))[:, None]


def _cells(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell before each point, and the fraction of the way to the next."""
    x = np.clip(x, 0, count - 1)
    cell = np.minimum(np.floor(x), count - 2)
    return cell, x - cell


def _limited_bend(flow: Float32[np.ndarray, "r c 2"], axis: int) -> Float32[np.ndarray, "r c 2"]:
    """Return second differences between each cell and the next along an axis; zero for the last."""
    bend = np.zeros_like(flow)
    if flow.shape[axis] < 3:
        return bend
    second = np.diff(flow, 2, axis)
    # At the border there is only one.
    both = np.concatenate([second.take([0], axis), second, second.take([-1], axis)], axis)
    first, last = (both.take(range(k, k + flow.shape[axis] - 1), axis) for k in (0, 1))
    smaller = np.where(np.abs(first) < np.abs(last), first, last)
    inner = bend[:, :-1] if axis == 1 else bend[:-1]
    inner[...] = np.where(first * last > 0, smaller, 0)
    return bend


def bilinear(field: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Interpolate a field at columns and rows bilinearly; the border is replicated."""
    return cv2.remap(field, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
