"""The loops of distances to triangles, in numba."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def triangle_distance(point, triangle):
    """Distance of a point to a triangle (its corners in rows).

    It is that to the plane where the foot of the perpendicular lies inside, else that to the
    nearest of the three edges.
    """
    ux, uy, uz = _difference(triangle[1], triangle[0])
    vx, vy, vz = _difference(triangle[2], triangle[0])
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    inside = length > 0
    nearest = np.inf
    for corner in range(3):
        start = triangle[corner]
        ex, ey, ez = _difference(triangle[(corner + 1) % 3], start)
        rx, ry, rz = _difference(point, start)
        turn = (ey * rz - ez * ry) * nx + (ez * rx - ex * rz) * ny + (ex * ry - ey * rx) * nz
        inside = inside and turn >= 0
        squared = ex * ex + ey * ey + ez * ez
        fraction = (rx * ex + ry * ey + rz * ez) / squared if squared > 0 else 0.0
        fraction = min(max(fraction, 0.0), 1.0)
        dx, dy, dz = rx - fraction * ex, ry - fraction * ey, rz - fraction * ez
        nearest = min(nearest, math.sqrt(dx * dx + dy * dy + dz * dz))
    if not inside:
        return nearest
    rx, ry, rz = _difference(point, triangle[0])
    return abs(rx * nx + ry * ny + rz * nz) / length


@njit(cache=True, nogil=True, error_model="numpy")
def _difference(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_faces(points, near, first, around, corners):
    """Distance of each point to the nearest of the faces around some vertices of its own.

    points (k, 3); near (k, j): the vertices; corners (m, 3, 3): of the faces, float64.
    """
    found = np.full(len(points), np.inf)
    for k in range(len(points)):
        for vertex in near[k]:
            for place in range(first[vertex], first[vertex + 1]):
                found[k] = min(found[k], triangle_distance(points[k], corners[around[place]]))
    return found
