"""Single-view losses and their gradients over a span of rows, for float32 arrays.

Each span works alone: it visits the rows around it again instead of writing outside itself, so the
result does not depend on how the image is cut. Loops run over whole rows without branches for the
compiler to vectorise, and functions take whole arrays and a row, because slices are slow to
compile. NaN must compare as NaN, hence no ``nnan``.
"""

import numpy as np
from numba import njit

PART = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}
ZERO, ONE, HUGE = np.float32(0), np.float32(1), np.float32(1e30)


@njit(**PART)
def known_depth(depth, alpha, prior, y, min_alpha, clean, r):
    """Row ``y`` of the depth where it is visible and no mask excludes it, else 0, to row ``r``."""
    for x in range(depth.shape[1]):
        d = depth[y, x]
        shown = (d > ZERO) & (d < HUGE) & (alpha[y, x] > min_alpha) & (prior[y, x] >= ZERO)
        clean[r, x] = d if shown else ZERO


@njit(**PART)
def pixel_terms(clean, r, alpha, spread, prior, confidence, y, settings, pull, g_alpha, g_spread):
    """Weighted sum of L_d, L_dist and the opacity terms over row ``y``, and its gradients."""
    total, relative = ZERO, settings.relative > ZERO
    for x in range(clean.shape[1]):
        a, s, d, f = alpha[y, x], spread[y, x], clean[r, x], prior[y, x]
        solid = abs(a) < HUGE
        empty, filled = solid & (f < ZERO), solid & (f >= ZERO)
        opaque = settings.opacity if filled else ZERO
        hollow = settings.silhouette if empty else ZERO
        total += opaque * (ONE - a) if filled else ZERO
        total += hollow * a if empty else ZERO
        g_alpha[y, x] = hollow - opaque
        thick = settings.distortion if (d > ZERO) & (abs(s) < HUGE) else ZERO
        total += thick * s if thick > ZERO else ZERO
        g_spread[y, x] = thick
        known = (d > ZERO) & (f > ZERO)
        w = settings.depth * confidence[y, x] / (f if relative else ONE) if known else ZERO
        e = d - f if known else ZERO
        total += w * abs(e)
        pull[r, x] += w * np.sign(e)
    return total


@njit(**PART)
def normal_terms(clean, r, normal, prior, y, settings, g_normal):
    """Weighted sum of L_n over row ``y``; adds to the normal's gradient."""
    weight, epsilon = settings.normal, settings.normal_epsilon
    total = ZERO
    for x in range(clean.shape[1]):
        ax, ay, az = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
        fx, fy, fz = prior[y, x, 0], prior[y, x, 1], prior[y, x, 2]
        length = ax * ax + ay * ay + az * az
        if (clean[r, x] > ZERO) & (length < HUGE) & (fx * fx + fy * fy + fz * fz > ZERO):
            shrink = ONE / np.sqrt(length + epsilon)
            ax, ay, az = ax * shrink, ay * shrink, az * shrink
            ex, ey, ez = ax - fx, ay - fy, az - fz
            total += weight * (abs(ex) + abs(ey) + abs(ez))
            ex, ey, ez = np.sign(ex), np.sign(ey), np.sign(ez)
            along, w = ex * ax + ey * ay + ez * az, weight * shrink
            g_normal[y, x, 0] += w * (ex - along * ax)
            g_normal[y, x, 1] += w * (ey - along * ay)
            g_normal[y, x, 2] += w * (ez - along * az)
    return total


@njit(**PART)
def consistency_terms(clean, r, normal, edge, y, settings, push, g, g_y):
    """Weighted sum of L_nc over the centres of row ``y``.

    ``push`` (4, w) receives d/dD at the left, right, upper and lower neighbour of each centre;
    the normal's gradient is added to row ``g_y`` of ``g``. Depths are 0 where unknown.
    """
    fx, fy, cx, cy = settings.fx, settings.fy, settings.cx, settings.cy
    weight, epsilon = settings.consistency, settings.normal_epsilon
    ry, step_x, step_y = (np.float32(y) - cy) / fy, ONE / fx, ONE / fy
    total = ZERO
    for i in range(clean.shape[1] - 2):
        x = i + 1
        dl, dc, dr = clean[r, i], clean[r, x], clean[r, x + 1]
        dt, db = clean[r - 1, x], clean[r + 1, x]
        known = (dl > ZERO) & (dc > ZERO) & (dr > ZERO) & (dt > ZERO) & (db > ZERO)
        rx = (np.float32(x) - cx) / fx
        # h = P_right - P_left, v = P_top - P_bottom: rays differ by a step in one coordinate.
        hx, hz = dr * (rx + step_x) - dl * (rx - step_x), dr - dl
        hy = ry * hz
        vy, vz = dt * (ry - step_y) - db * (ry + step_y), dt - db
        vx = rx * vz
        kx, ky, kz = hy * vz - hz * vy, hz * vx - hx * vz, hx * vy - hy * vx
        inverse = ONE / np.sqrt(kx * kx + ky * ky + kz * kz + np.float32(1e-30))
        kx, ky, kz = kx * inverse, ky * inverse, kz * inverse

        ax, ay, az = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
        ax = ax if abs(ax) < HUGE else ZERO
        ay = ay if abs(ay) < HUGE else ZERO
        az = az if abs(az) < HUGE else ZERO
        shrink = ONE / np.sqrt(ax * ax + ay * ay + az * az + epsilon)
        ax, ay, az = ax * shrink, ay * shrink, az * shrink
        cosine = ax * kx + ay * ky + az * kz
        w = weight * (ONE - edge[y, x]) if known else ZERO
        total += w * (ONE - cosine)

        s = -w * shrink
        g[g_y, x, 0] += s * (kx - cosine * ax)
        g[g_y, x, 1] += s * (ky - cosine * ay)
        g[g_y, x, 2] += s * (kz - cosine * az)
        s = -w * inverse
        gx, gy, gz = s * (ax - cosine * kx), s * (ay - cosine * ky), s * (az - cosine * kz)
        # Through k = h x v: d/dh = v x g, d/dv = g x h; then along the neighbours' rays.
        ux, uy, uz = vy * gz - vz * gy, vz * gx - vx * gz, vx * gy - vy * gx
        wx, wy, wz = gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx
        across, down = rx * ux + ry * uy + uz, rx * wx + ry * wy + wz
        push[0, x] = step_x * ux - across
        push[1, x] = step_x * ux + across
        push[2, x] = down - step_y * wy
        push[3, x] = -down - step_y * wy
    return total


@njit(**PART)
def add_consistency(pull, r, push):
    """Adds what each centre of row ``r`` pushed to its four neighbours."""
    for i in range(pull.shape[1] - 2):
        pull[r, i] += push[0, i + 1]
        pull[r - 1, i + 1] += push[2, i + 1]
        pull[r + 1, i + 1] += push[3, i + 1]
    for i in range(pull.shape[1] - 2):
        pull[r, i + 2] += push[1, i + 1]


@njit(**PART)
def smoothness_terms(clean, r, gradient, y, settings, scale, pull):
    """Weighted sum of L_ds over row ``y``; ``scale`` is 1 over the median depth."""
    weight, eta, both = settings.smoothness, settings.eta, settings.rewards_edges
    total = ZERO
    for x in range(clean.shape[1] - 1):
        dc, dr, db = clean[r, x], clean[r, x + 1], clean[r + 1, x]
        if (dc > ZERO) & (dr > ZERO) & (db > ZERO):
            across, down, contrast = dr - dc, db - dc, gradient[y, x]
            step = scale * (abs(across) + abs(down))
            keep, reward = np.exp(-eta * contrast), both * contrast * np.exp(-eta * step)
            total += weight * (step * keep + reward)
            slope = weight * scale * (keep - eta * reward)
            gx, gy = slope * np.sign(across), slope * np.sign(down)
            pull[r, x] -= gx + gy
            pull[r, x + 1] += gx
            pull[r + 1, x] += gy
    return total


@njit(cache=True, **PART)
def single_view_rows(
    first, last, depth, normal, alpha, spread, edge, gradient, prior, confidence, prior_normal,
    settings, scale, scratch, loss, g_depth, g_normal, g_alpha, g_spread,
):  # fmt: skip
    """Rows ``first <= y < last`` of the single-view loss and of its gradients.

    ``settings`` are a record of ``SingleViewSettings``; ``scale`` is 1 over the median depth.
    ``prior`` is negative outside a mask. ``prior_normal`` has no rows without a prior. ``scratch``
    (3, rows, w) has at least 5 and last - first + 4 rows. ``loss[y]`` is the row's sum; ``scratch``
    and ``g_normal`` are 0 on entry.
    """
    clean, pull, push = scratch[0], scratch[1], scratch[2]
    low, high = max(first - 2, 0), min(last + 2, depth.shape[0])
    for y in range(low, high):
        known_depth(depth, alpha, prior, y, settings.min_alpha, clean, y - low)
    unused = np.zeros((1, depth.shape[1], 3), np.float32)
    for y in range(low, high):
        r, own, total = y - low, first <= y < last, ZERO
        if own:
            total += pixel_terms(
                clean, r, alpha, spread, prior, confidence, y, settings, pull, g_alpha,
                g_spread,
            )  # fmt: skip
            if settings.normal > ZERO and len(prior_normal) > 0:
                total += normal_terms(clean, r, normal, prior_normal, y, settings, g_normal)
        if settings.consistency > ZERO and 0 < r < high - low - 1:
            g, g_y = (g_normal, y) if own else (unused, 0)
            total += consistency_terms(clean, r, normal, edge, y, settings, push, g, g_y)
            add_consistency(pull, r, push)
        if settings.smoothness > ZERO and r < high - low - 1:
            total += smoothness_terms(clean, r, gradient, y, settings, scale, pull)
        if own:
            loss[y] = total
    for y in range(first, last):
        for x in range(depth.shape[1]):
            g_depth[y, x] = pull[y - low, x]
