"""Projection of disks into the camera: one record and one box of pixels each.

The arithmetic is float64 (disks are few compared with pixels), so that disks seen edge-on keep
their digits. Vectors are tuples of three floats.
"""

import math

import numba
import numpy as np

from geogs.kernel_parts import inlined
from geogs.splat.cpu import layout as at
from geogs.splat.cpu.layout import MARGIN, MIN_ALPHA, PER_DISK, TILE_HEIGHT, TILE_WIDTH
from geogs.splat.reference import MAX_LOG_SCALE, MAX_REACH_RATIO, MIN_FACING

_PART = inlined(PER_DISK)
_SQRT_HALF = math.sqrt(0.5)


@numba.njit(**_PART)
def dot(a, b):
    """a . b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(**_PART)
def rotate(T, v):
    """R v for the left 3 x 3 block of T."""
    return (
        T[0, 0] * v[0] + T[0, 1] * v[1] + T[0, 2] * v[2],
        T[1, 0] * v[0] + T[1, 1] * v[1] + T[1, 2] * v[2],
        T[2, 0] * v[0] + T[2, 1] * v[1] + T[2, 2] * v[2],
    )


@numba.njit(**_PART)
def axes_of(w, x, y, z):
    """Columns of the rotation matrix of a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@numba.njit(**_PART)
def unit_quaternion(quaternion, i):
    """The normalised quaternion of disk i, and 1 / norm."""
    w = np.float64(quaternion[i, 0])
    x = np.float64(quaternion[i, 1])
    y = np.float64(quaternion[i, 2])
    z = np.float64(quaternion[i, 3])
    inverse_norm = 1 / math.sqrt(w * w + x * x + y * y + z * z)
    return (w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm), inverse_norm


@numba.njit(**_PART)
def place(position, i, T):
    """Disk i's position in the world and in the camera."""
    p = (np.float64(position[i, 0]), np.float64(position[i, 1]), np.float64(position[i, 2]))
    c = rotate(T, p)
    return p, (c[0] + T[0, 3], c[1] + T[1, 3], c[2] + T[2, 3])


@numba.njit(**_PART)
def bounded_facing(normal, center):
    """n . c kept away from zero, and whether it had to be."""
    facing = dot(normal, center)
    least = MIN_FACING * math.sqrt(dot(center, center))
    if abs(facing) < least:
        return (-least if facing < 0 else least), True
    return facing, False


@numba.njit(**_PART)
def pixel_range(low, high, count):
    """Pixels first..last of a line of ``count`` whose centres lie between low and high."""
    low = min(max(low - MARGIN, -1.0), float(count))
    high = min(max(high + MARGIN, -1.0), float(count))
    return max(math.ceil(low), 0), min(math.floor(high) + 1, count)


@numba.njit(**_PART)
def outline_of(mx, my, c, u, v, opacity, intrinsics, outline):
    """Bound the pixels where the disk can have at least ``MIN_ALPHA``; false if there is no bound.

    ``u`` and ``v`` are the scaled tangents in the camera. The radius in deviations follows from the
    opacity. On the disk's plane it is an ellipse in the image: the dual conic of the circle, about
    the projected centre, M diag(r^2, r^2, -1) M^T with M = K [u v c]. Around the projected centre
    it is the circle of the low-pass Gaussian. A disk that reaches behind the camera has no bounds:
    its circle is infinite.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    radius2 = 2 * math.log(opacity / MIN_ALPHA)
    outline[at.CENTER_X] = mx
    outline[at.CENTER_Y] = my
    outline[at.BLUR] = math.sqrt(radius2 / 2)
    d = radius2 * (u[2] * u[2] + v[2] * v[2]) - c[2] * c[2]
    if d > -1e-6 * c[2] * c[2]:
        outline[at.BLUR] = np.inf
        outline[at.MIDDLE_X] = mx
        outline[at.HALF_X] = -1
        return False
    x, y = c[0] / c[2], c[1] / c[2]
    ux, vx = fx * (u[0] - x * u[2]), fx * (v[0] - x * v[2])
    uy, vy = fy * (u[1] - y * u[2]), fy * (v[1] - y * v[2])
    k = radius2 / d
    ox, oy = k * (ux * u[2] + vx * v[2]), k * (uy * u[2] + vy * v[2])
    xx = max(ox * ox - k * (ux * ux + vx * vx), 1e-6)
    yy = max(oy * oy - k * (uy * uy + vy * vy), 1e-6)
    xy = ox * oy - k * (ux * uy + vx * vy)
    outline[at.MIDDLE_X] = mx + ox
    outline[at.MIDDLE_Y] = my + oy
    outline[at.HALF_X] = math.sqrt(xx)
    outline[at.HALF_Y] = math.sqrt(yy)
    outline[at.SLOPE] = xy / xx
    outline[at.SIDE] = math.sqrt(max(yy - xy * xy / xx, 0.0))
    outline[at.TOP] = xy / outline[at.HALF_Y]
    return True


@numba.njit(**_PART)
def box_of(outline, width, height):
    """Pixels (x0, x1, y0, y1) within an outline."""
    x = outline[at.CENTER_X]
    y = outline[at.CENTER_Y]
    blur = outline[at.BLUR]
    middle = outline[at.MIDDLE_X]
    half = outline[at.HALF_X]
    x0, x1 = pixel_range(min(middle - half, x - blur), max(middle + half, x + blur), width)
    middle = outline[at.MIDDLE_Y]
    half = outline[at.HALF_Y]
    y0, y1 = pixel_range(min(middle - half, y - blur), max(middle + half, y + blur), height)
    return x0, x1, y0, y1


@numba.njit(**_PART)
def sigmoid(x):
    """1 / (1 + exp(-x))"""
    return 1 / (1 + math.exp(-np.float64(x)))


@numba.njit(**_PART)
def is_usable(position, quaternion, log_scale, opacity_logit, i):
    """Whether disk i's numbers are finite, its quaternion not zero and its scales sensible."""
    total = position[i, 0] + position[i, 1] + position[i, 2] + opacity_logit[i]
    q = abs(quaternion[i, 0]) + abs(quaternion[i, 1]) + abs(quaternion[i, 2])
    q += abs(quaternion[i, 3])
    s = max(abs(log_scale[i, 0]), abs(log_scale[i, 1])) + 0 * (log_scale[i, 0] + log_scale[i, 1])
    return abs(total) < np.inf and 0 < q < np.inf and s < MAX_LOG_SCALE


@numba.njit(**PER_DISK)
def project_disks(
    position, quaternion, log_scale, opacity_logit, T, intrinsics, near, width, height,
    start, stop, records, outlines, boxes, pairs,
):  # fmt: skip
    """Fill records, boxes (x0, x1, y0, y1) and the number of tiles touched of disks start..stop.

    ``T`` is (3, 4) world to camera, float64. A disk that no pixel can blend touches no tile.
    """
    fx, fy, cx, cy = intrinsics
    for i in range(start, stop):
        pairs[i] = 0
        _, c = place(position, i, T)
        if not c[2] > near or not is_usable(position, quaternion, log_scale, opacity_logit, i):
            continue
        opacity = sigmoid(opacity_logit[i])
        if opacity < MIN_ALPHA:
            continue
        tu, tv, n = axes_of(*unit_quaternion(quaternion, i)[0])
        a = rotate(T, tu)
        b = rotate(T, tv)
        n = rotate(T, n)
        su, sv = math.exp(np.float64(log_scale[i, 0])), math.exp(np.float64(log_scale[i, 1]))
        u, v = (su * a[0], su * a[1], su * a[2]), (sv * b[0], sv * b[1], sv * b[2])
        mx, my = fx * c[0] / c[2] + cx, fy * c[1] / c[2] + cy
        x0, x1, y0, y1 = 0, width, 0, height
        if outline_of(mx, my, c, u, v, opacity, intrinsics, outlines[i]):
            x0, x1, y0, y1 = box_of(outlines[i], width, height)
        if x0 >= x1 or y0 >= y1:
            continue
        boxes[i, 0] = x0
        boxes[i, 1] = x1
        boxes[i, 2] = y0
        boxes[i, 3] = y1
        columns = (x1 - 1) // TILE_WIDTH - x0 // TILE_WIDTH + 1
        pairs[i] = columns * ((y1 - 1) // TILE_HEIGHT - y0 // TILE_HEIGHT + 1)
        facing, _ = bounded_facing(n, c)
        ex, ey = n[0] / facing, n[1] / facing
        ac = dot(a, c)
        bc = dot(b, c)
        ku, kv = _SQRT_HALF / su, _SQRT_HALF / sv
        reach = 3 * math.sqrt(u[2] * u[2] + v[2] * v[2])
        away = -1.0 if facing > 0 else 1.0
        r = records[i]
        r[at.MX] = mx
        r[at.MY] = my
        r[at.OPACITY] = opacity
        r[at.UX] = ku * (a[0] - ac * ex) / fx
        r[at.UY] = ku * (a[1] - ac * ey) / fy
        r[at.VX] = kv * (b[0] - bc * ex) / fx
        r[at.VY] = kv * (b[1] - bc * ey) / fy
        r[at.WX] = ex / fx
        r[at.WY] = ey / fy
        r[at.WC] = 1 / c[2]
        r[at.NX] = away * n[0]
        r[at.NY] = away * n[1]
        r[at.NZ] = away * n[2]
        r[at.Z_NEAREST] = c[2] - min(reach, c[2] - near)
        r[at.Z_FURTHEST] = c[2] + min(reach, MAX_REACH_RATIO * c[2])
