"""Normals for smooth shading of a mesh except at its edges."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

ANGLE = 30.0
"""Least angle of an edge, in degrees, between a face and the mean normal of its corner, or between
two faces."""
MOST = 0.3
"""Least fraction of the area around a vertex at such an angle: slivers make no edge."""
_STEPS = 100
"""Quantisation steps per unit of a normal's coordinates; equal normals are merged."""


class CreasedFaces(NamedTuple):
    """Faces whose vertices are split along edges, one for each side."""

    origin: Int[np.ndarray, "k"]
    """Original vertex of each."""
    faces: Int[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "k 3"]
    """Float32 unit normals; zero where there is no area."""


def creased(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> CreasedFaces:
    """Compute vertex normals of a mesh, with vertices split at its edges.

    They are area-weighted means over the adjacent faces; at an edge over those of similar normal.
    """
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    area = np.cross(b - a, c - a)
    facing = _unit(area)
    limit = np.cos(np.radians(ANGLE))
    means = _unit(_sums(faces.T.reshape(-1), np.tile(area, (3, 1)), len(vertices)))
    is_edge = _on_edges(faces, area, facing, means, limit)
    face, corner = np.nonzero(is_edge[faces])
    order = np.argsort(faces[face, corner], kind="stable")
    face = face[order]
    corner = corner[order]
    vertex = faces[face, corner]
    normals = _means_of_alike(vertex, area[face], facing[face], limit)
    rows = np.column_stack([vertex, np.rint(_STEPS * normals).astype(np.int64)])
    _, first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    kept = np.flatnonzero(~is_edge)
    place = np.full(len(vertices), -1)
    place[kept] = np.arange(len(kept))
    split = place[faces]
    split[face, corner] = len(kept) + group.reshape(-1)
    origin = np.concatenate([kept, vertex[first]])
    own = np.concatenate([means[kept], normals[first]]).astype(np.float32)
    return CreasedFaces(origin, split.astype(np.int32), own)


def _on_edges(
    faces: Int[np.ndarray, "m 3"],
    area: Float[np.ndarray, "m 3"],
    facing: Float[np.ndarray, "m 3"],
    means: Float[np.ndarray, "n 3"],
    limit: float,
) -> Bool[np.ndarray, "n"]:
    """Whether much of the area around a vertex deviates from its mean normal."""
    size = np.linalg.norm(area, axis=1)
    away = np.zeros(len(means))
    total = np.zeros(len(means))
    for corner in faces.T:
        is_away = (facing * means[corner]).sum(1) < limit
        away += np.bincount(corner, size * is_away, len(means))
        total += np.bincount(corner, size, len(means))
    return away > MOST * total


def _means_of_alike(
    vertex: Int[np.ndarray, "n"],
    area: Float[np.ndarray, "n 3"],
    facing: Float[np.ndarray, "n 3"],
    limit: float,
) -> Float[np.ndarray, "n 3"]:
    """Return the mean normal, at each corner, of the faces of similar normal at its vertex.

    Corners are sorted by vertex; ``area``: face normals with length area, ``facing``: unit normals.
    """
    _, start, count = np.unique(vertex, return_index=True, return_counts=True)
    start = np.repeat(start, count)
    count = np.repeat(count, count)
    one = np.repeat(np.arange(len(vertex)), count)
    other = start[one] + np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count)
    alike = (facing[one] * facing[other]).sum(1) > limit
    return _unit(_sums(one[alike], area[other[alike]], len(vertex)))


def _sums(
    place: Int[np.ndarray, "n"], rows: Float[np.ndarray, "n 3"], count: int
) -> Float[np.ndarray, "k 3"]:
    return np.stack([np.bincount(place, column, count) for column in rows.T], 1).astype(np.float64)


def _unit(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
