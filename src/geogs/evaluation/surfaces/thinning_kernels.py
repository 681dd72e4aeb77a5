"""Greedy thinning and regular samples of triangles, in numba."""

import math

import numpy as np
from numba import njit

_PRIMES = (73856093, 19349663, 83492791)


@njit(cache=True, nogil=True, error_model="numpy")
def thin_in_order(points, radius, kept):
    """Keep a point unless a kept earlier one is at most ``radius`` away.

    Kept points are chained by the cell of size ``radius`` that holds them. Different cells may
    share a chain, which costs time only, as the distance decides.
    """
    size = 1024
    while size < 2 * len(points):
        size *= 2
    head = np.full(size, -1, np.int64)
    following = np.full(len(points), -1, np.int64)
    limit = radius * radius
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cx, cy, cz = math.floor(x / radius), math.floor(y / radius), math.floor(z / radius)
        free = True
        # The point's own cell first: where points are dense it holds the one that removes it.
        for cell in range(28):
            k = cell - 1 if cell > 0 else 13
            dx, dy, dz = k // 9 - 1, (k // 3) % 3 - 1, k % 3 - 1
            place = _place(cx + dx, cy + dy, cz + dz, size)
            j = head[place]
            while j >= 0:
                a, b, c = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                if a * a + b * b + c * c <= limit:
                    free = False
                    break
                j = following[j]
            if not free:
                break
        kept[i] = free
        if free:
            place = _place(cx, cy, cz, size)
            following[i] = head[place]
            head[place] = i


@njit(cache=True, nogil=True, error_model="numpy")
def _place(x, y, z, size):
    """Chain of a cell."""
    return ((x * _PRIMES[0]) ^ (y * _PRIMES[1]) ^ (z * _PRIMES[2])) & (size - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _steps(a, b, c, spacing):
    """Numbers of steps along the first and second edge of a triangle; -1 where it has no area."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area2 = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not area2 > 0.0:
        return -1, -1
    first = math.sqrt(ux * ux + uy * uy + uz * uz)
    second = math.sqrt(vx * vx + vy * vy + vz * vz)
    step = spacing * math.sqrt(first * second / area2)
    return math.floor(first / step), math.floor(second / step)


@njit(cache=True, nogil=True, error_model="numpy")
def grid_samples(vertices, faces, spacing, out):
    """Write the regular samples of all triangles as far as there is room; returns their number."""
    count = 0
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        n, m = _steps(a, b, c, spacing)
        if n < 1 or m < 1:
            continue
        for i in range(n):
            s = (i + 0.5) / n
            for j in range(m):
                t = (j + 0.5) / m
                if s + t >= 1.0:
                    break
                if count < len(out):
                    for k in range(3):
                        out[count, k] = a[k] + s * (b[k] - a[k]) + t * (c[k] - a[k])
                count += 1
    return count
