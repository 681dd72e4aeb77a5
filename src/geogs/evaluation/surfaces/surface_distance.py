"""Exact distances of millions of points to a surface, with the nearest points on it."""

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
        self._triangles = corners.reshape(-1, 9)
        self._boxes = _boxes(corners)

    def __call__(
        self, points: Float[np.ndarray, "n 3"], maximum: float = np.inf
    ) -> Float[np.ndarray, "n"]:
        """Unsigned distances in the unit of the points; inf where they are above ``maximum``."""
        return self.nearest(points, maximum)[0]

    def nearest(
        self, points: Float[np.ndarray, "n 3"], maximum: float = np.inf
    ) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Distances, and the nearest triangles; any where a distance is above ``maximum``."""
        from geogs.evaluation.surfaces.surface_kernels import nearest_triangles

        points = np.asarray(points, np.float64)
        order = _along_curve(points)
        parts = np.split(order, range(_BATCH, len(order), _BATCH))
        distance = np.empty(len(points))
        face = np.empty(len(points), np.int64)

        def search(part: Int[np.ndarray, "k"]) -> None:
            d = np.empty(len(part))
            place = np.zeros(len(part), np.int64)
            tree = (self._triangles, self._boxes, _LEAF)
            nearest_triangles(points[part], *tree, maximum, d, place)
            distance[part] = d
            face[part] = self._order[place]

        thread_map(search, parts)
        return distance, face


class SurfaceDistance:
    """Distances from points to a surface.

    For a mesh they are exact distances to the nearest triangle, independent of the tessellation.
    For a point set they are distances to the nearest point, which include its spacing.
    """

    def __init__(self, surface: Surface) -> None:
        from scipy.spatial import cKDTree

        self._surface = surface
        self._tree = TriangleTree(surface) if surface.is_mesh else cKDTree(surface.vertices)

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Unsigned distances in the unit of the points."""
        return self.nearest(points)[0]

    def nearest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"] | None]:
        """Distances, nearest surface points and, for a mesh, the normals there."""
        surface = self._surface
        if not isinstance(self._tree, TriangleTree):
            distance, index = self._tree.query(points, workers=-1)
            return distance, surface.vertices[index], None
        distance, face = self._tree.nearest(points)
        corners = (surface.vertices[surface.faces[face, i]] for i in range(3))
        return distance, closest_point_on_triangle(points, *corners), surface.face_normals[face]


def closest_point_on_triangle(
    p: Float[np.ndarray, "n 3"],
    a: Float[np.ndarray, "n 3"],
    b: Float[np.ndarray, "n 3"],
    c: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """The point of triangle abc nearest to p, row by row.

    The foot of the perpendicular where it falls inside, else the nearest point of the three edges.
    """
    normal = np.cross(b - a, c - a)
    squared = (normal * normal).sum(1, keepdims=True)
    safe = np.where(squared > 0, squared, 1)
    height = ((p - a) * normal).sum(1, keepdims=True) / safe
    foot = p - height * normal
    inside = squared[:, 0] > 0
    best = foot
    distance = np.full(len(p), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, foot - start) * normal).sum(1) >= 0
        edge = end - start
        length = (edge * edge).sum(1, keepdims=True)
        s = ((p - start) * edge).sum(1, keepdims=True) / np.where(length > 0, length, 1)
        on_edge = start + np.clip(s, 0, 1) * edge
        d = ((on_edge - p) ** 2).sum(1)
        best = np.where((d < distance)[:, None], on_edge, best)
        distance = np.minimum(distance, d)
    return np.where(inside[:, None], foot, best)


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
    low = points.min(0)
    extent = np.ptp(points, axis=0).max()
    cells = ((points - low) / (extent or 1.0) * (2**_BITS - 1)).astype(np.int64)
    return np.argsort(morton_codes(cells, _BITS), kind="stable")
