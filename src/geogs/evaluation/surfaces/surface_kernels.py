"""Loops over pixels, points and triangles of surfaces, in numba."""

import math

import numpy as np
from numba import njit

_NEAR = 1e-3
_PRIMES = (73856093, 19349663, 83492791)
_STACK = 64


@njit(cache=True, nogil=True, error_model="numpy")
def _box(vertex, cx, cy, fx, fy, width, height):
    """Pixel box of a triangle in camera coordinates after cutting it at the near plane."""
    u0 = np.inf
    u1 = -np.inf
    v0 = np.inf
    v1 = -np.inf
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
            u0 = min(u0, u)
            u1 = max(u1, u)
            v0 = min(v0, v)
            v1 = max(v1, v)
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
    ax = t[0]
    ay = t[1]
    az = t[2]
    bx = t[3]
    by = t[4]
    bz = t[5]
    cx = t[6]
    cy = t[7]
    cz = t[8]
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
        stack[0] = 1
        bounds[0] = _to_box(px, py, pz, boxes[1])
        size = 1
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
            near = 2 * node
            far = 2 * node + 1
            to_near = left
            to_far = right
            if right < left:
                near, far, to_near, to_far = far, near, right, left
            if to_far <= best:
                stack[size] = far
                bounds[size] = to_far
                size += 1
            if to_near <= best:
                stack[size] = near
                bounds[size] = to_near
                size += 1
        before = np.sqrt(found)
        distance[i] = before


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
