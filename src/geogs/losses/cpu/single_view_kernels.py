"""Single-view losses and their gradients over a span of rows, for float32 arrays.

Each span works alone: it visits the rows around it again instead of writing outside itself, so the
result does not depend on how the image is cut. Loops run over whole rows without branches for the
compiler to vectorise, and functions take whole arrays and a row, because slices are slow to
compile. NaN must compare as NaN, so there is no ``nnan``.
"""

import numpy as np
from numba import njit

from geogs.kernel_parts import inlined

KERNEL = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}
PART = inlined(KERNEL)
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
    total = ZERO
    relative = settings.relative > ZERO
    for x in range(clean.shape[1]):
        a = alpha[y, x]
        s = spread[y, x]
        d = clean[r, x]
        f = prior[y, x]
        solid = abs(a) < HUGE
        empty = solid & (f < ZERO)
        filled = solid & (f >= ZERO)
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
    weight = settings.normal
    epsilon = settings.normal_epsilon
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
            along = ex * ax + ey * ay + ez * az
            w = weight * shrink
            g_normal[y, x, 0] += w * (ex - along * ax)
            g_normal[y, x, 1] += w * (ey - along * ay)
            g_normal[y, x, 2] += w * (ez - along * az)
    return total


@njit(**PART)
def split_normals(normal, y, lines):
    """The coordinates of row ``y``'s normals as three rows; 0 where they are not finite."""
    for k in range(3):
        for x in range(normal.shape[1]):
            value = normal[y, x, k]
            lines[k, x] = value if abs(value) < HUGE else ZERO


@njit(**PART)
def consistency_terms(clean, r, edge, y, settings, lines, push):
    """Weighted sum of L_nc over the centres of row ``y``.

    ``lines`` (6, w): coordinates of the normals, and their gradients, which it receives. ``push``
    (4, w) receives d/dD at the left, right, upper and lower neighbour of each centre. Depths are 0
    where unknown.
    """
    fx, fy, cx, cy = settings.fx, settings.fy, settings.cx, settings.cy
    weight = settings.consistency
    epsilon = settings.normal_epsilon
    ry = (np.float32(y) - cy) / fy
    step_x = ONE / fx
    step_y = ONE / fy
    width = clean.shape[1]
    # Views from the first centre on, because an index that could be negative would keep the loop
    # from vectorising.
    left = clean[r, : width - 2]
    centre = clean[r, 1 : width - 1]
    right = clean[r, 2:width]
    above, below = clean[r - 1, 1 : width - 1], clean[r + 1, 1 : width - 1]
    nx, ny, nz = lines[0, 1 : width - 1], lines[1, 1 : width - 1], lines[2, 1 : width - 1]
    g_x, g_y, g_z = lines[3, 1 : width - 1], lines[4, 1 : width - 1], lines[5, 1 : width - 1]
    to_left = push[0, 1 : width - 1]
    to_right = push[1, 1 : width - 1]
    to_above = push[2, 1 : width - 1]
    to_below = push[3, 1 : width - 1]
    edges = edge[y, 1 : width - 1]
    total = ZERO
    for i in range(width - 2):
        dl, dc, dr, dt, db = left[i], centre[i], right[i], above[i], below[i]
        known = (dl > ZERO) & (dc > ZERO) & (dr > ZERO) & (dt > ZERO) & (db > ZERO)
        rx = (np.float32(np.int32(i + 1)) - cx) * step_x
        # h = P_right - P_left, v = P_top - P_bottom: rays differ by a step in one coordinate.
        hx, hz = dr * (rx + step_x) - dl * (rx - step_x), dr - dl
        hy = ry * hz
        vy, vz = dt * (ry - step_y) - db * (ry + step_y), dt - db
        vx = rx * vz
        kx, ky, kz = hy * vz - hz * vy, hz * vx - hx * vz, hx * vy - hy * vx
        inverse = ONE / np.sqrt(kx * kx + ky * ky + kz * kz + np.float32(1e-30))
        kx, ky, kz = kx * inverse, ky * inverse, kz * inverse

        ax, ay, az = nx[i], ny[i], nz[i]
        shrink = ONE / np.sqrt(ax * ax + ay * ay + az * az + epsilon)
        ax, ay, az = ax * shrink, ay * shrink, az * shrink
        cosine = ax * kx + ay * ky + az * kz
        w = weight * (ONE - edges[i]) if known else ZERO
        total += w * (ONE - cosine)

        s = -w * shrink
        g_x[i] = s * (kx - cosine * ax)
        g_y[i] = s * (ky - cosine * ay)
        g_z[i] = s * (kz - cosine * az)
        s = -w * inverse
        gx, gy, gz = s * (ax - cosine * kx), s * (ay - cosine * ky), s * (az - cosine * kz)
        # Through k = h x v: d/dh = v x g, d/dv = g x h; then along the neighbours' rays.
        ux, uy, uz = vy * gz - vz * gy, vz * gx - vx * gz, vx * gy - vy * gx
        wx, wy, wz = gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx
        across = rx * ux + ry * uy + uz
        down = rx * wx + ry * wy + wz
        to_left[i] = step_x * ux - across
        to_right[i] = step_x * ux + across
        to_above[i] = down - step_y * wy
        to_below[i] = -down - step_y * wy
    return total


@njit(**PART)
def add_normal_gradient(lines, y, g_normal):
    """Adds the gradients of row ``y``'s normals, which have none at the border."""
    for x in range(1, g_normal.shape[1] - 1):
        for k in range(3):
            g_normal[y, x, k] += lines[3 + k, x]


@njit(**PART)
def add_consistency(pull, r, push):
    """Adds the gradients from each centre of row ``r`` to its four neighbours."""
    for i in range(pull.shape[1] - 2):
        pull[r, i] += push[0, i + 1]
        pull[r - 1, i + 1] += push[2, i + 1]
        pull[r + 1, i + 1] += push[3, i + 1]
    for i in range(pull.shape[1] - 2):
        pull[r, i + 2] += push[1, i + 1]


@njit(**PART)
def smoothness_terms(clean, r, gradient, y, settings, scale, pull):
    """Weighted sum of L_ds over row ``y``; ``scale`` is 1 over the median depth."""
    weight = settings.smoothness
    eta = settings.eta
    both = settings.rewards_edges
    total = ZERO
    for x in range(clean.shape[1] - 1):
        dc, dr, db = clean[r, x], clean[r, x + 1], clean[r + 1, x]
        if (dc > ZERO) & (dr > ZERO) & (db > ZERO):
            across = dr - dc
            down = db - dc
            contrast = gradient[y, x]
            step = scale * (abs(across) + abs(down))
            keep = np.exp(-eta * contrast)
            reward = both * contrast * np.exp(-eta * step)
            total += weight * (step * keep + reward)
            slope = weight * scale * (keep - eta * reward)
            gx, gy = slope * np.sign(across), slope * np.sign(down)
            pull[r, x] -= gx + gy
            pull[r, x + 1] += gx
            pull[r + 1, x] += gy
    return total


@njit(**KERNEL)
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
    clean = scratch[0]
    pull = scratch[1]
    push = scratch[2]
    low, high = max(first - 2, 0), min(last + 2, depth.shape[0])
    for y in range(low, high):
        known_depth(depth, alpha, prior, y, settings.min_alpha, clean, y - low)
    lines = np.zeros((6, depth.shape[1]), np.float32)
    for y in range(low, high):
        r = y - low
        own = first <= y < last
        total = ZERO
        if own:
            total += pixel_terms(
                clean, r, alpha, spread, prior, confidence, y, settings, pull, g_alpha, g_spread
            )
            if settings.normal > ZERO and len(prior_normal) > 0:
                total += normal_terms(clean, r, normal, prior_normal, y, settings, g_normal)
        if settings.consistency > ZERO and 0 < r < high - low - 1:
            split_normals(normal, y, lines)
            total += consistency_terms(clean, r, edge, y, settings, lines, push)
            add_consistency(pull, r, push)
            if own:
                add_normal_gradient(lines, y, g_normal)
        if settings.smoothness > ZERO and r < high - low - 1:
            total += smoothness_terms(clean, r, gradient, y, settings, scale, pull)
        if own:
            loss[y] = total
    for y in range(first, last):
        for x in range(depth.shape[1]):
            g_depth[y, x] = pull[y - low, x]
