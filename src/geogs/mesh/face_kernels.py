"""Loops over all faces of a mesh, in numba."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def normal_sums(vertices, faces):
    """Cross products of two edges of each face, added up at its three vertices."""
    total = np.zeros((len(vertices), 3), np.float64)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = (
            np.float64(vertices[a, 0]),
            np.float64(vertices[a, 1]),
            np.float64(vertices[a, 2]),
        )
        ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for k in (a, b, c):
            total[k, 0] += x
            total[k, 1] += y
            total[k, 2] += z
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def face_sizes(vertices, faces, squared_area):
    """Fill in four times the squared area of each face; the mean squared length of all edges."""
    total = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = (
            np.float64(vertices[a, 0]),
            np.float64(vertices[a, 1]),
            np.float64(vertices[a, 2]),
        )
        ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        squared_area[f] = x * x + y * y + z * z
        total += ux * ux + uy * uy + uz * uz
        total += vx * vx + vy * vy + vz * vz + wx * wx + wy * wy + wz * wz
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
