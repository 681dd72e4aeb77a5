"""Compiled loops of the refinement: photometric steps on slanted patches, local plane fits.

A surface is described per pixel by its inverse depth and the two slopes of inverse depth in units
per render pixel: a plane in space has constant slopes. Rows are processed sample by sample so that
the loops over x vectorise; all but the gathering of image samples does. Kernels with parameters
``first`` and ``last`` process the rows from ``first`` to before ``last``.
"""

import numpy as np
from numba import njit

from geogs.depth.sampling_kernels import fetch_pairs
from geogs.kernel_parts import inlined

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
_PART = inlined(_FAST)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)


@njit(**_PART)
def _place_row(pairs, a, b, y, ox, oy, rho, slope_x, slope_y, index, fu, fv, du, dv, inside):
    """Positions of one row's samples in an image, and their derivatives by inverse depth.

    The patch sample (ox, oy) of pixel (x, y) has inverse depth rho + slope_x ox + slope_y oy and
    projects to a p + rho b (homogeneous).
    """
    h, w = pairs.shape
    last_u, last_v = np.float32(w - 1.001), np.float32(h - 1.001)
    s0, s1, s2 = np.float32(a[0, 0]), np.float32(a[1, 0]), np.float32(a[2, 0])
    b0, b1, b2 = np.float32(b[0]), np.float32(b[1]), np.float32(b[2])
    py = y + oy
    c0 = np.float32(a[0, 0] * ox + a[0, 1] * py + a[0, 2])
    c1 = np.float32(a[1, 0] * ox + a[1, 1] * py + a[1, 2])
    c2 = np.float32(a[2, 0] * ox + a[2, 1] * py + a[2, 2])
    for x in range(rho.shape[0]):
        column = np.float32(np.int32(x))
        r = rho[x] + ox * slope_x[x] + oy * slope_y[x]
        q2 = c2 + s2 * column + r * b2
        inverse = ONE / max(q2, np.float32(1e-3))
        u = (c0 + s0 * column + r * b0) * inverse
        v = (c1 + s1 * column + r * b1) * inverse
        cu = min(max(u, ZERO), last_u)
        cv = min(max(v, ZERO), last_v)
        gone = abs(cu - u) + abs(cv - v) + max(np.float32(1e-3) - q2, ZERO)
        inside[x] = ZERO if gone > ZERO else inside[x]
        whole_u, whole_v = np.floor(cu), np.floor(cv)
        fu[x] = cu - whole_u
        fv[x] = cv - whole_v
        index[x] = np.uint32(np.int32(whole_v * np.float32(w) + whole_u))
        du[x] = (b0 - cu * b2) * inverse
        dv[x] = (b1 - cv * b2) * inverse


@njit(**_PART)
def _add_moments(reference, weight, top, low, fu, fv, du, dv, sums):
    """Weighted first and second moments of reference a with sample b and its derivative g by
    inverse depth, and of these: b, g, bb, gg, ab, ag, bg. ``top`` and ``low`` are the samples'
    pixels in pairs."""
    for x in range(fu.shape[0]):
        left_top = top[2 * x]
        left_low = low[2 * x]
        right_top = top[2 * x + 1] - left_top
        right_low = low[2 * x + 1] - left_low
        above, below = left_top + fu[x] * right_top, left_low + fu[x] * right_low
        down = below - above
        across = right_top + (right_low - right_top) * fv[x]
        q = above + fv[x] * down
        g = across * du[x] + down * dv[x]
        m = weight[x]
        p = reference[x]
        mp, mq, mg = m * p, m * q, m * g
        sums[0, x] += mq
        sums[1, x] += mg
        sums[2, x] += mq * q
        sums[3, x] += mg * g
        sums[4, x] += mp * q
        sums[5, x] += mp * g
        sums[6, x] += mq * g


@njit(**_FAST)
def photometric_step(
    first, last, patches, offsets, weights, pairs, a, b, rho, slope_x, slope_y, floor, step,
    curvature,
):  # fmt: skip
    """One Gauss-Newton step per pixel on the zero-mean normalised patches of all neighbours.

    patches (s, h, w): the reference at each patch sample; offsets (s, 2): (x, y) in render pixels;
    weights (s, h, w): support weights; pairs: ``pixel_pairs`` of the neighbours. Writes the step
    of inverse depth and the curvature of the sum of (1 - NCC) by inverse depth; neighbours that do
    not match (NCC below 0.4, or partly out of view) have weight 0, better ones a larger weight.
    """
    count, _, w = patches.shape
    n = pairs.shape[0]
    index = np.empty(w, np.uint32)
    top = np.empty(w, np.uint64)
    low = np.empty(w, np.uint64)
    upper = top.view(np.float32)
    lower = low.view(np.float32)
    fu, fv = np.empty(w, np.float32), np.empty(w, np.float32)
    du, dv = np.empty(w, np.float32), np.empty(w, np.float32)
    inside = np.empty(w, np.float32)
    own = np.empty((3, w), np.float32)
    sums = np.empty((7, w), np.float32)
    total = np.empty((2, w), np.float32)
    for y in range(first, last):
        total[:] = ZERO
        own[:] = ZERO
        for s in range(count):
            _accumulate_own(patches[s, y], weights[s, y], own)
        for j in range(n):
            sums[:] = ZERO
            inside[:] = ONE
            for s in range(count):
                _place_row(
                    pairs[j], a[j], b[j], np.float32(y), offsets[s, 0], offsets[s, 1], rho[y],
                    slope_x[y], slope_y[y], index, fu, fv, du, dv, inside,
                )  # fmt: skip
                fetch_pairs(pairs[j], index, top, low)
                _add_moments(patches[s, y], weights[s, y], upper, lower, fu, fv, du, dv, sums)
            _add_neighbour(own, sums, inside, floor, total)
        for x in range(w):
            curvature[y, x] = total[1, x]
            step[y, x] = total[0, x] / (total[1, x] + np.float32(1e-6))


@njit(**_PART)
def _accumulate_own(reference, weight, own):
    """Weighted first and second moments of reference a, the same for all neighbours."""
    for x in range(reference.shape[0]):
        m = weight[x]
        p = reference[x]
        own[0, x] += m
        own[1, x] += m * p
        own[2, x] += m * p * p


@njit(**_PART)
def _add_neighbour(own, sums, inside, floor, total):
    """NCC of one neighbour, its derivative and Gauss-Newton curvature, added with its weight."""
    for x in range(inside.shape[0]):
        norm = ONE / own[0, x]
        ma, mb, mg = own[1, x] * norm, sums[0, x] * norm, sums[1, x] * norm
        va = max(own[2, x] * norm - ma * ma, ZERO) + floor
        vb = max(sums[2, x] * norm - mb * mb, ZERO) + floor
        vg = max(sums[3, x] * norm - mg * mg, ZERO)
        ab = sums[4, x] * norm - ma * mb
        ag = sums[5, x] * norm - ma * mg
        bg = sums[6, x] * norm - mb * mg
        scale = ONE / np.sqrt(va * vb)
        ncc = ab * scale
        climb = ag * scale - ncc * bg / vb
        curve = max(vg / vb - (bg / vb) * (bg / vb), ZERO)
        good = max(ncc - np.float32(0.4), ZERO)
        weight = inside[x] * good * good
        total[0, x] += weight * climb
        total[1, x] += weight * curve


@njit(**_FAST)
def fit_planes(
    first, last, rho, slope_x, slope_y, confidence, guide, radius, contrast, tolerance, stiffness,
    new_rho, new_x, new_y, support,
):  # fmt: skip
    """Weighted least-squares plane of inverse depth around each pixel (bilateral, robust).

    The weight of a pixel within ``radius`` is the product of its confidence, its likeness in colour
    1 / (1 + contrast |dI|^2) over ``guide`` (3, h, w), and its closeness to the current plane
    1 / (1 + (d rho / (tolerance rho))^2). ``stiffness`` ties the slopes to their current values.
    ``support`` is the sum of weights.
    """
    h, w = rho.shape
    # Sums over one row of samples; their factor is the same for the whole row.
    row = np.empty((5, w), np.float32)
    sums = np.empty((9, w), np.float32)
    for y in range(first, last):
        sums[:] = ZERO
        for j in range(-radius, radius + 1):
            yy = y + j
            if yy < 0 or yy >= h:
                continue
            row[:] = ZERO
            for i in range(-radius, radius + 1):
                left, right = max(0, -i), min(w, w - i)
                _add_samples(
                    rho, slope_x, slope_y, confidence, guide, y, yy, i, left, right, contrast,
                    tolerance, row,
                )  # fmt: skip
            _add_row(row, np.float32(j), sums)
        for x in range(w):
            s0, sx, sy = sums[0, x] + np.float32(1e-9), sums[1, x], sums[2, x]
            xx = sums[3, x] - sx * sx / s0 + stiffness
            xy = sums[4, x] - sx * sy / s0
            yy_ = sums[5, x] - sy * sy / s0 + stiffness
            rx = sums[7, x] - sx * sums[6, x] / s0
            ry = sums[8, x] - sy * sums[6, x] / s0
            det = xx * yy_ - xy * xy + np.float32(1e-12)
            gx = (rx * yy_ - ry * xy) / det
            gy = (ry * xx - rx * xy) / det
            new_rho[y, x] = rho[y, x] + (sums[6, x] - gx * sx - gy * sy) / s0
            new_x[y, x] = slope_x[y, x] + gx
            new_y[y, x] = slope_y[y, x] + gy
            support[y, x] = sums[0, x]


@njit(**_PART)
def _add_samples(
    rho, slope_x, slope_y, confidence, guide, y, yy, dx, first, last, contrast, tolerance, sums
):
    """Moments by dx of the residuals to the planes of row y at samples (dx, yy - y) away."""
    # Views, because an index that could be negative would keep the loop from vectorising.
    here, there = rho[y, first:last], rho[yy, first + dx : last + dx]
    gx, gy = slope_x[y, first:last], slope_y[y, first:last]
    conf = confidence[yy, first + dx : last + dx]
    fx, fy = np.float32(dx), np.float32(yy - y)
    t0, t1, t2 = sums[0, first:last], sums[1, first:last], sums[2, first:last]
    t3, t4 = sums[3, first:last], sums[4, first:last]
    g0, g1, g2 = guide[0, y, first:last], guide[1, y, first:last], guide[2, y, first:last]
    k0, k1 = guide[0, yy, first + dx : last + dx], guide[1, yy, first + dx : last + dx]
    k2 = guide[2, yy, first + dx : last + dx]
    for x in range(last - first):
        r = there[x] - here[x] - fx * gx[x] - fy * gy[x]
        c0, c1, c2 = g0[x] - k0[x], g1[x] - k1[x], g2[x] - k2[x]
        far = r / (tolerance * here[x])
        like = ONE + contrast * (c0 * c0 + c1 * c1 + c2 * c2)
        m = conf[x] / (like * (ONE + far * far))
        t0[x] += m
        t1[x] += m * fx
        t2[x] += m * fx * fx
        t3[x] += m * r
        t4[x] += m * r * fx


@njit(**_PART)
def _add_row(row, fy, sums):
    """Add the moments by x of a row that is ``fy`` away to the moments by x and y."""
    for x in range(row.shape[1]):
        m = row[0, x]
        mx = row[1, x]
        r = row[3, x]
        sums[0, x] += m
        sums[1, x] += mx
        sums[2, x] += m * fy
        sums[3, x] += row[2, x]
        sums[4, x] += mx * fy
        sums[5, x] += m * fy * fy
        sums[6, x] += r
        sums[7, x] += row[4, x]
        sums[8, x] += r * fy
