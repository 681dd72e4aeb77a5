"""Distances from points to a surface, with the nearest points on it."""

import numpy as np
from jaxtyping import Float

from geogs.evaluation.surfaces.surface import Surface
from geogs.evaluation.surfaces.triangle_tree import TriangleTree


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
    best, distance = foot, np.full(len(p), np.inf)
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
