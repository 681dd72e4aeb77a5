"""Backward projection: from gradients of the records to those of the parameters and the pose."""

import math

import numba
import numpy as np

from geogs.kernel_parts import inlined
from geogs.splat.cpu import layout as at
from geogs.splat.cpu.layout import PER_DISK
from geogs.splat.cpu.project import axes_of, bounded_facing, dot, place, rotate, unit_quaternion

_PART = inlined(PER_DISK)
_SQRT_HALF = math.sqrt(0.5)


@numba.njit(**_PART)
def rotate_back(T, v):
    """R^T v"""
    return (
        T[0, 0] * v[0] + T[1, 0] * v[1] + T[2, 0] * v[2],
        T[0, 1] * v[0] + T[1, 1] * v[1] + T[2, 1] * v[2],
        T[0, 2] * v[0] + T[1, 2] * v[1] + T[2, 2] * v[2],
    )


@numba.njit(**_PART)
def add_outer(matrix, a, b):
    """matrix += a b^T"""
    for r in range(3):
        for k in range(3):
            matrix[r, k] += a[r] * b[k]


@numba.njit(**_PART)
def quaternion_gradient(q, inverse_norm, a, b, n):
    """Gradient of the quaternion, given those of the columns of the rotation matrix."""
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


@numba.njit(**_PART)
def record_backward(record, g, axes, c, ku, kv, intrinsics):
    """Gradients of the camera-frame tangents, normal and centre from the pixels' sums ``g``.

    ``ku``, ``kv`` are sqrt(1/2) over the scales. The record's formulas are in ``project_disks``.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    a, b, n = axes
    facing, is_bounded = bounded_facing(n, c)
    h = 1 / facing
    ac = dot(a, c)
    bc = dot(b, c)
    # With e = n / (n . c): u = ku (a - (a . c) e) / f, v = kv (b - (b . c) e) / f, w = e / f.
    pu = ku * g[at.G_UX] / fx, ku * g[at.G_UY] / fy
    pv = kv * g[at.G_VX] / fx, kv * g[at.G_VY] / fy
    g_ex = g[at.G_WX] / fx - ac * pu[0] - bc * pv[0]
    g_ey = g[at.G_WY] / fy - ac * pu[1] - bc * pv[1]
    g_ac = -h * (pu[0] * n[0] + pu[1] * n[1])
    g_bc = -h * (pv[0] * n[0] + pv[1] * n[1])
    g_facing = 0.0 if is_bounded else -h * h * (g_ex * n[0] + g_ey * n[1])
    away = -1.0 if facing > 0 else 1.0
    g_a = (pu[0] + g_ac * c[0], pu[1] + g_ac * c[1], g_ac * c[2])
    g_b = (pv[0] + g_bc * c[0], pv[1] + g_bc * c[1], g_bc * c[2])
    g_n = (
        h * g_ex + g_facing * c[0] + away * g[at.G_NX],
        h * g_ey + g_facing * c[1] + away * g[at.G_NY],
        g_facing * c[2] + away * g[at.G_NZ],
    )
    # A pixel's offset is its position minus the projected centre, and enters u, v, w and rho2.
    g_u, g_v, g_w = g[at.G_U], g[at.G_V], g[at.G_W]
    g_mx = fx * (g[at.G_MX] - g_u * record[at.UX] - g_v * record[at.VX] - g_w * record[at.WX])
    g_my = fy * (g[at.G_MY] - g_u * record[at.UY] - g_v * record[at.VY] - g_w * record[at.WY])
    # g_w is the sum for w where the plane gave the depth; where the depth was clamped to a constant
    # distance from the centre, G_CLAMPED goes to c_z directly.
    x = c[0] / c[2]
    y = c[1] / c[2]
    inverse_z = 1 / c[2]
    g_c = (
        g_ac * a[0] + g_bc * b[0] + g_facing * n[0] + g_mx * inverse_z,
        g_ac * a[1] + g_bc * b[1] + g_facing * n[1] + g_my * inverse_z,
        g_ac * a[2]
        + g_bc * b[2]
        + g_facing * n[2]
        + g[at.G_CLAMPED]
        - (g_mx * x + g_my * y + g_w * inverse_z) * inverse_z,
    )
    return g_a, g_b, g_n, g_c


@numba.njit(**PER_DISK)
def sum_pairs(slots, entries, gradients, start, stop, sums):
    """Sum the gradients of the pairs of each of the disks start..stop, always in the same order."""
    # A loop of a width known only at run time is vectorised; one of a constant width is unrolled.
    width = sums.shape[1]
    for i in range(start, stop):
        for k in range(width):
            sums[i, k] = 0
        for s in range(slots[i], slots[i + 1]):
            e = entries[s]
            for k in range(width):
                sums[i, k] += gradients[e, k]


@numba.njit(**PER_DISK)
def project_disks_backward(
    position, quaternion, log_scale, T, intrinsics, records, slots, sums, start, stop,
    d_position, d_quaternion, d_log_scale, d_opacity_logit, d_T,
):  # fmt: skip
    """Gradients of disks start..stop, and this range's part of the (3, 4) pose gradient."""
    for i in range(start, stop):
        if slots[i] == slots[i + 1]:
            d_position[i, :] = 0
            d_quaternion[i, :] = 0
            d_log_scale[i, :] = 0
            d_opacity_logit[i] = 0
            continue
        r = records[i]
        g = sums[i]
        p, c = place(position, i, T)
        q, inverse_norm = unit_quaternion(quaternion, i)
        tu, tv, tn = axes_of(*q)
        axes = rotate(T, tu), rotate(T, tv), rotate(T, tn)
        ku = _SQRT_HALF * math.exp(-np.float64(log_scale[i, 0]))
        kv = _SQRT_HALF * math.exp(-np.float64(log_scale[i, 1]))
        g_a, g_b, g_n, g_c = record_backward(r, g, axes, c, ku, kv, intrinsics)
        d_log_scale[i, 0] = -(g[at.G_UX] * r[at.UX] + g[at.G_UY] * r[at.UY])
        d_log_scale[i, 1] = -(g[at.G_VX] * r[at.VX] + g[at.G_VY] * r[at.VY])
        opacity = np.float64(r[at.OPACITY])
        d_opacity_logit[i] = g[at.G_OPACITY] * opacity * (1 - opacity)
        world = rotate_back(T, g_c)
        d_position[i, 0], d_position[i, 1], d_position[i, 2] = world
        columns = rotate_back(T, g_a), rotate_back(T, g_b), rotate_back(T, g_n)
        turned = quaternion_gradient(q, inverse_norm, *columns)
        d_quaternion[i, 0], d_quaternion[i, 1], d_quaternion[i, 2], d_quaternion[i, 3] = turned
        add_outer(d_T, g_a, tu)
        add_outer(d_T, g_b, tv)
        add_outer(d_T, g_n, tn)
        add_outer(d_T, g_c, p)
        for k in range(3):
            d_T[k, 3] += g_c[k]
