"""Nearest triangles through a tree of boxes, in numba."""

import numpy as np
from numba import njit

_STACK = 64


@njit(cache=True, nogil=True, error_model="numpy")
def _to_segment(px, py, pz, ax, ay, az, bx, by, bz):
    """Squared distance of a point to a segment."""
    ex, ey, ez = bx - ax, by - ay, bz - az
    dx, dy, dz = px - ax, py - ay, pz - az
    length = ex * ex + ey * ey + ez * ez
    s = 0.0
    if length > 0.0:
        s = min(max((dx * ex + dy * ey + dz * ez) / length, 0.0), 1.0)
    dx, dy, dz = dx - s * ex, dy - s * ey, dz - s * ez
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True, error_model="numpy")
def _side(px, py, pz, ax, ay, az, bx, by, bz, nx, ny, nz):
    """Positive where a point is on the inner side of the edge from a to b."""
    ex, ey, ez = bx - ax, by - ay, bz - az
    dx, dy, dz = px - ax, py - ay, pz - az
    return (ey * dz - ez * dy) * nx + (ez * dx - ex * dz) * ny + (ex * dy - ey * dx) * nz


@njit(cache=True, nogil=True, error_model="numpy")
def _to_triangle(px, py, pz, t):
    """Squared distance of a point to a triangle of nine numbers; it may be a line or a point."""
    ax, ay, az, bx, by, bz, cx, cy, cz = t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], t[8]
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    if (
        square > 0.0
        and _side(px, py, pz, ax, ay, az, bx, by, bz, nx, ny, nz) >= 0.0
        and _side(px, py, pz, bx, by, bz, cx, cy, cz, nx, ny, nz) >= 0.0
        and _side(px, py, pz, cx, cy, cz, ax, ay, az, nx, ny, nz) >= 0.0
    ):
        height = (px - ax) * nx + (py - ay) * ny + (pz - az) * nz
        return height * height / square
    first = _to_segment(px, py, pz, ax, ay, az, bx, by, bz)
    second = _to_segment(px, py, pz, bx, by, bz, cx, cy, cz)
    return min(first, second, _to_segment(px, py, pz, cx, cy, cz, ax, ay, az))


@njit(cache=True, nogil=True, error_model="numpy")
def _to_box(px, py, pz, box):
    """Squared distance of a point to a box (low, high)."""
    dx = max(box[0] - px, px - box[3], 0.0)
    dy = max(box[1] - py, py - box[4], 0.0)
    dz = max(box[2] - pz, pz - box[5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_triangles(points, triangles, boxes, leaf_size, maximum, distance, nearest):
    """Write the distance of every point to the nearest triangle and which that is; inf where it is
    above maximum.

    Node i of ``boxes`` has the children 2 i and 2 i + 1; the second half are leaves of
    ``leaf_size`` triangles each. The distance to the neighbour before bounds the next one's from
    above, which saves most of the work where points come in spatial order.
    """
    first_leaf = len(boxes) // 2
    stack = np.empty(_STACK, np.int64)
    bounds = np.empty(_STACK)
    before = np.inf
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        best = maximum * maximum
        if i > 0 and before < np.inf:
            dx, dy, dz = px - points[i - 1, 0], py - points[i - 1, 1], pz - points[i - 1, 2]
            reach = before + np.sqrt(dx * dx + dy * dy + dz * dz)
            # Rounding may not cut the true one off.
            best = min(best, reach * reach * (1.0 + 1e-9) + 1e-300)
        found = np.inf
        stack[0], bounds[0], size = 1, _to_box(px, py, pz, boxes[1]), 1
        while size > 0:
            size -= 1
            node = stack[size]
            if bounds[size] > best:
                continue
            if node >= first_leaf:
                start = (node - first_leaf) * leaf_size
                for k in range(start, min(start + leaf_size, len(triangles))):
                    d = _to_triangle(px, py, pz, triangles[k])
                    if d <= best:
                        best = d
                        found = d
                        nearest[i] = k
                continue
            left = _to_box(px, py, pz, boxes[2 * node])
            right = _to_box(px, py, pz, boxes[2 * node + 1])
            near, far, to_near, to_far = 2 * node, 2 * node + 1, left, right
            if right < left:
                near, far, to_near, to_far = far, near, right, left
            if to_far <= best:
                stack[size], bounds[size] = far, to_far
                size += 1
            if to_near <= best:
                stack[size], bounds[size] = near, to_near
                size += 1
        before = np.sqrt(found)
        distance[i] = before
