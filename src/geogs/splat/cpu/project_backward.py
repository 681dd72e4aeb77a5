"""From the pixels' gradients of the records to those of the parameters and the pose."""

import math

import numba
import numpy as np

from geogs.splat.cpu.layout import GRADIENT, PER_DISK
from geogs.splat.cpu.project import axes_of, bounded_facing, dot, place, rotate, unit_quaternion

_INLINE = {**PER_DISK, "cache": False}
_SQRT_HALF = math.sqrt(0.5)


@numba.njit(**_INLINE)
def rotate_back(T, v):
    """R^T v"""
    return (
        T[0, 0] * v[0] + T[1, 0] * v[1] + T[2, 0] * v[2],
        T[0, 1] * v[0] + T[1, 1] * v[1] + T[2, 1] * v[2],
        T[0, 2] * v[0] + T[1, 2] * v[1] + T[2, 2] * v[2],
    )


@numba.njit(**_INLINE)
def combine(s, a, t, b):
    """s a + t b"""
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


@numba.njit(**_INLINE)
def add_outer(matrix, a, b):
    """matrix += a b^T"""
    for r in range(3):
        for k in range(3):
            matrix[r, k] += a[r] * b[k]


@numba.njit(**_INLINE)
def quaternion_gradient(q, inverse_norm, a, b, n):
    """Through the rotation matrix, given the gradients of its columns, and the normalisation."""
    w, x, y, z = q
    gw = x * (b[2] - n[1]) + y * (n[0] - a[2]) + z * (a[1] - b[0])
    gx = -2 * x * (b[1] + n[2]) + y * (b[0] + a[1]) + z * (n[0] + a[2]) + w * (b[2] - n[1])
    gy = x * (b[0] + a[1]) - 2 * y * (a[0] + n[2]) + z * (n[1] + b[2]) + w * (n[0] - a[2])
    gz = x * (n[0] + a[2]) + y * (n[1] + b[2]) - 2 * z * (a[0] + b[1]) + w * (a[1] - b[0])
    radial = gw * w + gx * x + gy * y + gz * z
    k = 2 * inverse_norm
    return (
        k * (gw - radial * w),
        k * (gx - radial * x),
        k * (gy - radial * y),
        k * (gz - radial * z),
    )


@numba.njit(**PER_DISK)
def project_disks_backward(
    position, quaternion, T, intrinsics, records, slots, pair_gradients, start, stop,
    d_position, d_quaternion, d_log_scale, d_opacity_logit, d_T,
):  # fmt: skip
    """Gradients of disks start..stop, and this range's share of the (3, 4) pose gradient.

    Disk i's pairs hold the slots ``slots[i]``..``slots[i + 1]``; they are summed in that order.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    g = np.empty(GRADIENT)
    for i in range(start, stop):
        if slots[i] == slots[i + 1]:
            d_position[i] = 0
            d_quaternion[i] = 0
            d_log_scale[i] = 0
            d_opacity_logit[i] = 0
            continue
        for k in range(GRADIENT):
            g[k] = 0
        for s in range(slots[i], slots[i + 1]):
            for k in range(GRADIENT):
                g[k] += pair_gradients[s, k]
        record = records[i]
        ux, uy, vx, vy = record[2], record[3], record[4], record[5]
        opacity = np.float64(record[9])
        p, c = place(position, i, T)
        q, inverse_norm = unit_quaternion(quaternion, i)
        tu, tv, tn = axes_of(*q)
        a, b, n = rotate(T, tu), rotate(T, tv), rotate(T, tn)
        facing, is_bounded = bounded_facing(n, c)
        h = 1 / facing
        away = -1.0 if facing > 0 else 1.0
        ac, bc = dot(a, c), dot(b, c)

        # The pixel's offset enters u, v, w and the low-pass distance; the centre with minus sign.
        g_mx = g[10] - g[0] * ux - g[3] * vx - g[6] * record[6]
        g_my = g[11] - g[0] * uy - g[3] * vy - g[6] * record[7]
        # 1 / su and 1 / sv are read off the records' definition: u = k (a - (a . c) e) / f.
        d_log_scale[i, 0] = -(g[1] * ux + g[2] * uy)
        d_log_scale[i, 1] = -(g[4] * vx + g[5] * vy)
        d_opacity_logit[i] = g[12] * opacity * (1 - opacity)
