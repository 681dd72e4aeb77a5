"""Loops over pixels in numba: the z-buffer of a mesh, and points against masks."""

import math

import numpy as np
from numba import njit

_NEAR = 1e-3


@njit(cache=True, nogil=True, error_model="numpy")
def _box(vertex, cx, cy, fx, fy, width, height):
    """Pixel box of a triangle in camera coordinates after cutting it at the near plane."""
    u0, u1, v0, v1 = np.inf, -np.inf, np.inf, -np.inf
    for i in range(3):
        a, b = vertex[i], vertex[(i + 1) % 3]
        for end in range(2):
            x, y, z = a[0], a[1], a[2]
            if end == 1:
                if (a[2] < _NEAR) == (b[2] < _NEAR):
                    continue
                s = (_NEAR - a[2]) / (b[2] - a[2])
                x, y, z = a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), _NEAR
            elif z < _NEAR:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    left = math.ceil(min(max(u0, 0.0), width * 1.0))
    right = math.floor(max(min(u1, width - 1.0), -1.0))
    top = math.ceil(min(max(v0, 0.0), height * 1.0))
    bottom = math.floor(max(min(v1, height - 1.0), -1.0))
    return left, right, top, bottom


@njit(cache=True, nogil=True, error_model="numpy")
def rasterise(vertices, faces, fx, fy, cx, cy, depth, face):
    """Write nearest z (inf where nothing) and face (-1) of every pixel; both sides are drawn.

    With the corners as columns of M, M b = (x, y, 1) gives barycentric coordinates over z: the
    pixel's ray meets the triangle where all b are at least 0, at z = 1 / sum(b).
    """
    height, width = depth.shape
    m = np.empty((3, 3))
    rows = np.empty((3, 3))
    for f in range(len(faces)):
        for i in range(3):
            for k in range(3):
                m[i, k] = vertices[faces[f, i], k]
        left, right, top, bottom = _box(m, cx, cy, fx, fy, width, height)
        if left > right or top > bottom:
            continue
        for i in range(3):
            p, q = m[(i + 1) % 3], m[(i + 2) % 3]
            rows[i, 0] = p[1] * q[2] - p[2] * q[1]
            rows[i, 1] = p[2] * q[0] - p[0] * q[2]
            rows[i, 2] = p[0] * q[1] - p[1] * q[0]
        volume = m[0, 0] * rows[0, 0] + m[0, 1] * rows[0, 1] + m[0, 2] * rows[0, 2]
        if volume == 0.0:
            continue
        for y in range(top, bottom + 1):
            v = (y - cy) / fy
            for x in range(left, right + 1):
                u = (x - cx) / fx
                b0 = (rows[0, 0] * u + rows[0, 1] * v + rows[0, 2]) / volume
                b1 = (rows[1, 0] * u + rows[1, 1] * v + rows[1, 2]) / volume
                b2 = (rows[2, 0] * u + rows[2, 1] * v + rows[2, 2]) / volume
                if b0 >= 0.0 and b1 >= 0.0 and b2 >= 0.0:
                    z = 1.0 / (b0 + b1 + b2)
                    if z >= _NEAR and z < depth[y, x]:
                        depth[y, x] = z
                        face[y, x] = f


@njit(cache=True, nogil=True, error_model="numpy")
def keep_inside(points, T_cw, fx, fy, cx, cy, mask, kept):
    """Clear ``kept`` where a point falls on an unset pixel; outside the image it stays."""
    height, width = mask.shape
    for i in range(len(points)):
        if not kept[i]:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = T_cw[2, 0] * x + T_cw[2, 1] * y + T_cw[2, 2] * z + T_cw[2, 3]
        if depth <= 0.0:
            continue
        u = fx * (T_cw[0, 0] * x + T_cw[0, 1] * y + T_cw[0, 2] * z + T_cw[0, 3]) / depth + cx
        v = fy * (T_cw[1, 0] * x + T_cw[1, 1] * y + T_cw[1, 2] * z + T_cw[1, 3]) / depth + cy
        if not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        column, row = math.floor(u + 0.5), math.floor(v + 0.5)
        kept[i] = mask[row, column]
