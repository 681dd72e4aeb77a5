"""How far points lie from a mesh that should run through them."""

import numpy as np
from jaxtyping import Float, Int

from geogs.mesh.types import cross
from geogs.threads import worker_count

_NEAREST = 3
"""Vertices around a point whose faces are looked at."""


def deviations(
    points: Float[np.ndarray, "k 3"],
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
) -> Float[np.ndarray, "k"]:
    """Distance of each point to the nearest face of those around the vertices nearest to it.

    So it is the distance to the mesh, or a little more where faces differ much in size.
    """
    from scipy.spatial import cKDTree

    used = np.unique(faces)
    tree, count = cKDTree(vertices[used]), min(_NEAREST, len(used))
    _, near = tree.query(points, k=count, workers=worker_count())
    first, around = _faces_around(len(vertices), faces)
    corners = vertices.astype(np.float64)[faces]
    nearest = np.full(len(points), np.inf)
    for vertex in used[near.reshape(len(points), -1)].T:
        count = first[vertex + 1] - first[vertex]
        for turn in range(int(count.max(initial=0))):
            some = np.flatnonzero(turn < count)
            a, b, c = corners[around[first[vertex[some]] + turn]].transpose(1, 0, 2)
            distance = triangle_distance(points[some].astype(np.float64), a, b, c)
            nearest[some] = np.minimum(nearest[some], distance)
    return nearest


def triangle_distance(
    points: Float[np.ndarray, "k 3"],
    a: Float[np.ndarray, "k 3"],
    b: Float[np.ndarray, "k 3"],
    c: Float[np.ndarray, "k 3"],
) -> Float[np.ndarray, "k"]:
    """Distance of each point to a triangle of its own with the corners a, b, c.

    It is that to the plane where the foot of the perpendicular lies inside, else that to the
    nearest of the three edges.
    """
    normal = cross(b - a, c - a)
    length = np.sqrt(_dot(normal, normal))
    unit = normal / np.where(length > 0, length, 1.0)[:, None]
    inside = length > 0
    edges = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, ray = end - start, points - start
        inside &= _dot(cross(edge, ray), normal) >= 0
        squared = _dot(edge, edge)
        share = (_dot(ray, edge) / np.where(squared > 0, squared, 1.0)).clip(0, 1)
        rest = ray - share[:, None] * edge
        edges = np.minimum(edges, np.sqrt(_dot(rest, rest)))
    return np.where(inside, np.abs(_dot(points - a, unit)), edges)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _faces_around(n: int, faces: Int[np.ndarray, "m 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Where the faces of each vertex begin in the list of them, (n + 1), and that list."""
    vertex = faces.ravel()
    order = np.argsort(vertex, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(vertex, minlength=n))])
    return first, order // 3
