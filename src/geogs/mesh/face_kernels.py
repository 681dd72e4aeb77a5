"""Loops over all faces of a mesh, in numba."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _edge(vertices, a, b):
    """From one vertex to another, in double precision."""
    return (
        np.float64(vertices[b, 0]) - vertices[a, 0],
        np.float64(vertices[b, 1]) - vertices[a, 1],
        np.float64(vertices[b, 2]) - vertices[a, 2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _square(u):
    return u[0] * u[0] + u[1] * u[1] + u[2] * u[2]


@njit(cache=True, nogil=True, error_model="numpy")
def normal_sums(vertices, faces):
    """Cross products of two edges of each face, added up at its three vertices."""
    total = np.zeros((len(vertices), 3), np.float64)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        normal = _cross(_edge(vertices, a, b), _edge(vertices, a, c))
        for k in (a, b, c):
            for axis in range(3):
                total[k, axis] += normal[axis]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def face_sizes(vertices, faces, squared_area):
    """Fill in four times the squared area of each face; the mean squared length of all edges."""
    total = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u, v = _edge(vertices, a, b), _edge(vertices, a, c)
        squared_area[f] = _square(_cross(u, v))
        total += _square(u) + _square(v) + _square(_edge(vertices, b, c))
    return total / max(3 * len(faces), 1)


@njit(cache=True, nogil=True, error_model="numpy")
def border_edges(faces, vertices):
    """Edges (start, end) of faces that no face has in the other direction, face by face.

    Edges are listed by the smaller of their vertices, so that each looks through a few only.
    """
    first = np.zeros(vertices + 1, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            first[min(faces[f, k], faces[f, (k + 1) % 3]) + 1] += 1
    for v in range(vertices):
        first[v + 1] += first[v]
    place = first[:-1].copy()
    # The larger vertex; less than nothing where the edge comes from there.
    other = np.empty(3 * len(faces), np.int64)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            low, high = min(a, b), max(a, b)
            other[place[low]] = high if a == low else -high - 1
            place[low] += 1
    edges, found = np.empty((3 * len(faces), 2), np.int64), 0
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            low, high = min(a, b), max(a, b)
            wanted = -high - 1 if a == low else high
            is_shared = a == b
            for n in range(first[low], first[low + 1]):
                if other[n] == wanted:
                    is_shared = True
                    break
            if not is_shared:
                edges[found, 0], edges[found, 1] = a, b
                found += 1
    return edges[:found].copy()
