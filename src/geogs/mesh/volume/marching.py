"""Marching cubes: the zero level of distances on a grid, as triangles.

Lorensen and Cline (1987), with a table that is derived instead of written down. On each face of a
cell the corners inside are cut off by segments that lead from where the walk around the face enters
the inside to where it next leaves it. Since that looks at the face alone, the two cells that share
a face cut it alike, and the surface has no holes, however ambiguous its corners are.
"""

from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
"""Corners of a cell, as steps from its lowest."""
EDGES = np.array([[c, axis] for axis in range(3) for c in range(8) if not c >> axis & 1])
"""Edges of a cell: lower corner and axis."""
MOST_TRIANGLES = 5
"""Most triangles of a cell."""

Loop = list[int]
"""Edges of a cell that a piece of the surface passes in turn."""


def march(
    distance: Float[np.ndarray, "x y z"], seen: Bool[np.ndarray, "x y z"]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"], Int[np.ndarray, "m 3"]]:
    """Vertices in voxels, the axis of the voxel edge on which each lies, and triangles.

    Args:
        distance: negative inside; no value may be zero.
        seen: cells that give triangles, each at its upper corner.

    Triangles are counter-clockwise seen from outside. A voxel edge has one vertex.
    """
    from geogs.mesh.volume.marching_kernels import count_triangles, find_vertices, write_triangles

    cells, counts = np.ascontiguousarray(seen), triangle_counts()
    number = np.full((*distance.shape, 3), -1, np.int32)
    values = np.ascontiguousarray(distance, dtype=np.float32)
    total = count_triangles(values, cells, counts)
    faces = np.empty((total, 3), np.int64)
    vertices = find_vertices(values, cells, number)
    write_triangles(values, cells, counts, triangle_table(), EDGES, CORNERS, number, faces)
    position, axis = vertices[:, :3], vertices[:, 3].astype(np.int64)
    return np.ascontiguousarray(position), axis, faces


@cache
def triangle_counts() -> Int8[np.ndarray, "256"]:
    """Number of triangles of each case; bit c of a case is set if corner c lies inside."""
    return np.array([len(triangles_of(case)) for case in range(256)], np.int8)


@cache
def triangle_table() -> Int8[np.ndarray, "256 t 3"]:
    """Edges of the triangles of each case; unused entries are -1."""
    table = np.full((256, MOST_TRIANGLES, 3), -1, np.int8)
    for case in range(256):
        for n, triangle in enumerate(triangles_of(case)):
            table[case, n] = triangle
    return table


def triangles_of(case: int) -> list[tuple[int, int, int]]:
    """The triangles of a case: its loops as fans."""
    return [t for loop in loops_of(case) for t in _fan(loop)]


def loops_of(case: int) -> list[Loop]:
    """The edges of a cell that each piece of the surface passes, counter-clockwise from outside."""
    inside = [bool(case >> c & 1) for c in range(8)]
    following: dict[int, int] = {}
    for face in faces():
        steps = [(face[k], face[(k + 1) % 4]) for k in range(4)]
        for k, (a, b) in enumerate(steps):
            if inside[a] or not inside[b]:
                continue
            leaves = next(
                step for n in range(1, 4) if (step := steps[(k + n) % 4]) and not inside[step[1]]
            )
            following[_edge(a, b)] = _edge(*leaves)
    found: list[Loop] = []
    while following:
        loop = [min(following)]
        while (after := following.pop(loop[-1])) != loop[0]:
            loop.append(after)
        found.append(loop)
    return found


def faces() -> list[list[int]]:
    """The corners of each face of a cell, counter-clockwise seen from outside."""
    found = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        around = [0, u, u | v, v]
        found += [around[::-1], [corner | 1 << axis for corner in around]]
    return found


def _fan(loop: Loop) -> list[tuple[int, int, int]]:
    """Triangles of a loop, from the corner with fewest of their inner edges in a face of the cell.

    An edge in a face could meet one of the cell behind the face.
    """
    turns = [loop[k:] + loop[:k] for k in range(len(loop))]
    best = min(turns, key=lambda t: sum(_on_one_face(t[0], t[k]) for k in range(2, len(t) - 1)))
    return [(best[0], best[k], best[k + 1]) for k in range(1, len(best) - 1)]


def _on_one_face(first: int, second: int) -> bool:
    ends = [{int(c), int(c) | 1 << int(axis)} for c, axis in (EDGES[first], EDGES[second])]
    return any(ends[0] | ends[1] <= set(face) for face in faces())


def _edge(a: int, b: int) -> int:
    """The number of the edge between two corners."""
    low, axis = min(a, b), (a ^ b).bit_length() - 1
    return EDGES.tolist().index([low, axis])
