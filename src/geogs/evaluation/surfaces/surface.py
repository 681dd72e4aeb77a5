"""Surfaces to compare: reading them, sampling them, and exact distances to them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from geogs.errors import InputError
from geogs.io.ply_reader import PlyLists, read_ply


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
