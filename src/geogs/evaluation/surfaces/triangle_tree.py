"""Exact distances of millions of points to a triangle mesh."""

import numpy as np
from jaxtyping import Float, Int

from geogs.errors import InputError
from geogs.evaluation.surfaces.surface import Surface
from geogs.geometry.morton import morton_codes
from geogs.threads import thread_map

_LEAF = 4
_BITS = 21
_BATCH = 8_192


class TriangleTree:
    """A tree of bounding boxes over a mesh's triangles, ordered along a Z-curve.

    Distances are exact, to the nearest of all triangles. Points are queried in the same order, as
    each distance is bounded by the one before it.
    """

    def __init__(self, surface: Surface) -> None:
        """Raises InputError if there are no triangles."""
        if not surface.is_mesh:
            raise InputError("A surface has no triangles to measure distances to.")
        corners = np.ascontiguousarray(surface.vertices[surface.faces], np.float64)
        self._order = _along_curve(corners.mean(1))
        corners = corners[self._order]
        self._triangles, self._boxes = corners.reshape(-1, 9), _boxes(corners)

    def __call__(
        self, points: Float[np.ndarray, "n 3"], maximum: float = np.inf
    ) -> Float[np.ndarray, "n"]:
        """Unsigned distances in the unit of the points; inf where they are above ``maximum``."""
        return self.nearest(points, maximum)[0]

    def nearest(
        self, points: Float[np.ndarray, "n 3"], maximum: float = np.inf
    ) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Distances, and the nearest triangles; any where a distance is above ``maximum``."""
        points = np.asarray(points, np.float64)
        order = _along_curve(points)
        parts = np.split(order, range(_BATCH, len(order), _BATCH))
        found = thread_map(lambda part: self._nearest(points[part], maximum), parts)
        distance, face = np.empty(len(points)), np.empty(len(points), np.int64)
        for part, (d, place) in zip(parts, found, strict=True):
            distance[part], face[part] = d, self._order[place]
        return distance, face

    def _nearest(
        self, points: Float[np.ndarray, "n 3"], maximum: float
    ) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        from geogs.evaluation.surfaces.triangle_kernels import nearest_triangles

        distance, place = np.empty(len(points)), np.zeros(len(points), np.int64)
        tree = self._triangles, self._boxes, _LEAF
        nearest_triangles(points, *tree, maximum, distance, place)
        return distance, place


def _boxes(corners: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "k 6"]:
    """Boxes (low, high) of a full binary tree, node 1 the root; empty ones are inside out."""
    leaves = -(-len(corners) // _LEAF)
    size = 1 << (leaves - 1).bit_length()
    boxes = np.full((2 * size, 6), np.inf)
    boxes[:, 3:] = -np.inf
    starts = np.arange(0, len(corners), _LEAF)
    boxes[size : size + leaves, :3] = np.minimum.reduceat(corners.min(1), starts)
    boxes[size : size + leaves, 3:] = np.maximum.reduceat(corners.max(1), starts)
    while size > 1:
        size //= 2
        children = boxes[2 * size : 4 * size].reshape(size, 2, 6)
        boxes[size : 2 * size, :3] = children[..., :3].min(1)
        boxes[size : 2 * size, 3:] = children[..., 3:].max(1)
    return boxes


def _along_curve(points: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
    """The order of points along a Z-curve, quantised by their largest extent."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, extent = points.min(0), np.ptp(points, axis=0).max()
    cells = ((points - low) / (extent or 1.0) * (2**_BITS - 1)).astype(np.int64)
    return np.argsort(morton_codes(cells, _BITS), kind="stable")
