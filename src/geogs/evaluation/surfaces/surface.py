"""Surfaces to compare: reading them, sampling them, and exact distances to them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from geogs.errors import InputError
from geogs.io.ply_reader import PlyLists, read_ply

_SAMPLES_PER_FACE = 4
_LEAST_SAMPLES, _MOST_SAMPLES = 100_000, 2_000_000
_CANDIDATES = 8
_BATCH = 100_000


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, or a point set where there are no faces."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]

    @property
    def is_mesh(self) -> bool:
        """Whether there are triangles."""
        return len(self.faces) > 0

    @cached_property
    def areas(self) -> Float[np.ndarray, "m"]:
        """Area of each triangle."""
        a, b, c = self._corners()
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @cached_property
    def face_normals(self) -> Float[np.ndarray, "m 3"]:
        """Unit normal of each triangle; zero where it has no area."""
        a, b, c = self._corners()
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return normal / np.where(length > 0, length, 1)

    def transformed(self, T: Float[np.ndarray, "4 4"]) -> "Surface":
        """The surface moved by a rigid motion or similarity."""
        return Surface(self.vertices @ T[:3, :3].T + T[:3, 3], self.faces)

    def part(self, kept: Bool[np.ndarray, "m"]) -> "Surface":
        """The triangles ``kept`` alone, with the vertices they use."""
        faces = self.faces[kept]
        used, number = np.unique(faces, return_inverse=True)
        return Surface(self.vertices[used], number.reshape(faces.shape))

    def _corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return a, b, c


def read_surface(path: str | Path) -> Surface:
    """Read a PLY mesh (polygons are split into fans) or point cloud.

    Vertices that are not finite are dropped together with their faces. Raises InputError if the
    file is missing, no PLY, cut off, or holds no vertex.
    """
    elements = read_ply(path)
    vertex = elements.get("vertex")
    if (
        vertex is None
        or not {"x", "y", "z"} <= vertex.columns.keys()
        or not len(vertex.columns["x"])
    ):
        raise InputError(f"{path} holds no vertices.")
    vertices = np.stack([vertex.columns[axis].astype(np.float64) for axis in "xyz"], -1)
    lists = elements["face"].lists if "face" in elements else {}
    corners = lists.get("vertex_indices", lists.get("vertex_index"))
    faces = np.zeros((0, 3), np.int64) if corners is None else _fans(corners)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"{path} has faces that name vertices which are not there.")
    return _finite_part(vertices, faces)


def _fans(polygons: PlyLists) -> Int[np.ndarray, "m 3"]:
    """Triangles from the first corner of each polygon to its sides that do not touch it."""
    parts = np.maximum(polygons.lengths - 2, 0)
    first = np.repeat(np.cumsum(polygons.lengths) - polygons.lengths, parts)
    side = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(parts) - parts, parts)
    return polygons.values[np.stack([first, side, side + 1], 1)].astype(np.int64)


def _finite_part(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    finite = np.isfinite(vertices).all(1)
    if finite.all():
        return Surface(vertices, faces)
    number = np.cumsum(finite) - 1
    return Surface(vertices[finite], number[faces[finite[faces].all(1)]])


def sample_surface(
    surface: Surface, n: int, rng: np.random.Generator, stratified: bool = True
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """``n`` points uniform by area and the triangle of each.

    Stratified, each point has its own n-th part of the area to fall in; otherwise all are
    independent and in no order. A point set gives a random choice of its points (all if there are
    fewer), with triangle -1.
    """
    if not surface.is_mesh:
        m = len(surface.vertices)
        index = rng.choice(m, n, replace=False) if m > n else np.arange(m)
        return surface.vertices[index], np.full(len(index), -1)
    cumulative = np.cumsum(surface.areas)
    if not cumulative[-1] > 0:
        raise InputError("The mesh has no area, so it cannot be sampled.")
    at = (np.arange(n) + rng.random(n)) / n if stratified else rng.random(n)
    at = at * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, at, side="right"), len(cumulative) - 1)
    u, v = rng.random((2, n))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    a, b, c = (surface.vertices[surface.faces[face, i]] for i in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face


class SurfaceDistance:
    """Distances from points to a surface.

    To a mesh they are exact point-to-triangle distances, over the triangles of the eight nearest
    of many candidate points: every triangle's centre, for the small ones, and four area-uniform
    samples per triangle (0.1 to 2 million), for the large ones. So how densely the mesh is
    sampled or tessellated hardly enters (measured on a furnished room: an accuracy of 0.19 cm
    changes by 2 % with twice the samples and candidates). To a point set they are distances to
    the nearest point, which include its spacing.
    """

    def __init__(
        self,
        surface: Surface,
        box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None,
        seed: int = 0,
    ) -> None:
        """Only the part of a mesh within ``box`` (low, high) is considered if one is given."""
        from scipy.spatial import cKDTree

        self._surface = surface
        points, face = surface.vertices, np.full(len(surface.vertices), -1)
        if surface.is_mesh:
            points, face = _candidates(surface, np.random.default_rng(seed))
            if box is not None:
                inside = _in_box(points, *box)
                points, face = (points[inside], face[inside]) if inside.any() else (points, face)
        self._face, self._points = face, points
        self._tree = cKDTree(points, balanced_tree=False, compact_nodes=False)

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Unsigned distances in the unit of the points."""
        return self.nearest(points)[0]

    def nearest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"] | None]:
        """Distances, nearest surface points and, for a mesh, the normals there."""
        parts = [self._nearest(p) for p in np.split(points, range(_BATCH, len(points), _BATCH))]
        distance, closest = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
        if not self._surface.is_mesh:
            return distance, closest, None
        return distance, closest, np.concatenate([p[2] for p in parts])

    def _nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        if not self._surface.is_mesh:
            distance, index = self._tree.query(points, workers=-1)
            return distance, self._points[index], None
        k = min(_CANDIDATES, len(self._points))
        index = self._tree.query(points, k=k, workers=-1)[1].reshape(len(points), k)
        best = np.full(len(points), np.inf)
        closest, normal = np.zeros_like(points), np.zeros_like(points)
        faces = self._face[index]
        for n, column in enumerate(faces.T):
            # A triangle that several candidates are of is looked at once.
            rows = np.flatnonzero((faces[:, :n] != column[:, None]).all(1))
            face = column[rows]
            corners = (self._surface.vertices[self._surface.faces[face, i]] for i in range(3))
            candidate = closest_point_on_triangle(points[rows], *corners)
            distance = np.linalg.norm(candidate - points[rows], axis=1)
            better = distance < best[rows]
            rows = rows[better]
            best[rows], closest[rows] = distance[better], candidate[better]
            normal[rows] = self._surface.face_normals[face[better]]
        return best, closest, normal


def _candidates(
    surface: Surface, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Points of the mesh, and their triangles, near which nearest triangles are looked for."""
    m = len(surface.faces)
    n = min(max(_SAMPLES_PER_FACE * m, _LEAST_SAMPLES), _MOST_SAMPLES)
    points, face = sample_surface(surface, n, rng)
    centres = surface.vertices[surface.faces].mean(1)
    return np.concatenate([centres, points]), np.concatenate([np.arange(m), face])


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


def _in_box(
    points: Float[np.ndarray, "n 3"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "n"]:
    return np.asarray(((points >= low) & (points <= high)).all(1))
