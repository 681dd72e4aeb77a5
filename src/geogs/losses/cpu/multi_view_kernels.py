"""The multi-view loss and its gradients over a span of rows, for float32 arrays.

Three passes over the photometric image, each of which may be cut into spans of rows: warp,
correlate, pull back to the depth (and a fourth for the pose). A span writes only its own rows, and
every sum has one order, so the result does not depend on how the image is cut. NaN must compare as
NaN, so there is no ``nnan``.
"""

import numpy as np
from numba import njit

from geogs.losses.cpu.single_view_kernels import KERNEL, PART

ZERO, HALF, ONE, TWO, HUGE = (np.float32(v) for v in (0, 0.5, 1, 2, 1e30))


@njit(**PART)
def fetch_corners(image, us, vs, index, parts, corners):
    """Bilinear samples of a row of positions: ``corners`` (4, w) receives the pixels at the upper
    left, upper right, lower left and lower right, ``parts`` (2, w) the fractions.

    Positions are clamped to the image. Pixels are copied in a loop of their own, so that the others
    are vectorised.
    """
    height, width = image.shape
    last_u, last_v = np.float32(width - 1), np.float32(height - 1)
    most_i, most_j = np.float32(width - 2), np.float32(height - 2)
    for x in range(us.shape[0]):
        u, v = min(max(us[x], ZERO), last_u), min(max(vs[x], ZERO), last_v)
        i, j = min(np.floor(u), most_i), min(np.floor(v), most_j)
        parts[0, x] = u - i
        parts[1, x] = v - j
        index[x] = np.uint32(np.int32(j) * np.int32(width) + np.int32(i))
    flat = image.ravel()
    right = np.uint32(1)
    down = np.uint32(width)
    for x in range(us.shape[0]):
        k = index[x]
        corners[0, x] = flat[k]
        corners[1, x] = flat[k + right]
        k += down
        corners[2, x] = flat[k]
        corners[3, x] = flat[k + right]


@njit(**PART)
def hide_line(depth, lenses, tolerance, geometry, places, index, parts, corners):
    """Clears ``geometry[2]``, the depth in the target, where the target's depth map is nearer or
    farther by ``tolerance`` of it, or not known. The other arguments but ``lenses`` are scratch."""
    hx, hy = lenses[1, 2], lenses[1, 3]
    zoom_u, zoom_v = lenses[2, 0] / lenses[1, 0], lenses[2, 1] / lenses[1, 1]
    cx, cy = lenses[2, 2], lenses[2, 3]
    for x in range(geometry.shape[1]):
        places[0, x] = (geometry[0, x] - hx) * zoom_u + cx
        places[1, x] = (geometry[1, x] - hy) * zoom_v + cy
    fetch_corners(depth, places[0], places[1], index, parts, corners)
    for x in range(geometry.shape[1]):
        p = corners[0, x]
        q = corners[1, x]
        r = corners[2, x]
        s = corners[3, x]
        upper = p + (q - p) * parts[0, x]
        lower = r + (s - r) * parts[0, x]
        known = (p > ZERO) & (q > ZERO) & (r > ZERO) & (s > ZERO)
        z = geometry[2, x]
        near = abs(z - upper - (lower - upper) * parts[1, x]) < tolerance * z
        geometry[2, x] = z if known & near else ZERO


@njit(**PART)
def sample_line(y, geometry, parts, corners, reference, warped, slope, mask):
    """Row ``y`` of the warped image, its slope by depth and its mask from the corners of its
    samples; ``corners[2:]`` receive the image's derivatives along x and y."""
    for x in range(geometry.shape[1]):
        p = corners[0, x]
        q = corners[1, x]
        r = corners[2, x]
        s = corners[3, x]
        part = parts[1, x]
        upper = p + (q - p) * parts[0, x]
        lower = r + (s - r) * parts[0, x]
        seen = geometry[2, x] > ZERO
        du = (q - p) * (ONE - part) + (s - r) * part if seen else ZERO
        dv = lower - upper if seen else ZERO
        warped[y, x] = upper + (lower - upper) * part if seen else reference[y, x]
        mask[y, x] = ONE if seen else ZERO
        slope[y, x] = du * geometry[3, x] + dv * geometry[4, x]
        corners[2, x] = du
        corners[3, x] = dv


@njit(**PART)
def enlarge_line(depth, y, rows, row_part, columns, column_part, line, geometry):
    """Row ``y`` of the enlarged depth into ``geometry[5]``; 0 where a source pixel is unknown."""
    i = rows[0, y]
    k = rows[1, y]
    f = row_part[y]
    for x in range(depth.shape[1]):
        a, b = depth[i, x], depth[k, x]
        known = (a > ZERO) & (b > ZERO) & (a < HUGE) & (b < HUGE)
        line[x] = a + (b - a) * f if known else ZERO
    for x in range(geometry.shape[1]):
        a, b = line[columns[0, x]], line[columns[1, x]]
        geometry[5, x] = a + (b - a) * column_part[x] if (a > ZERO) & (b > ZERO) else ZERO


@njit(**PART)
def project_line(y, lenses, T, min_depth_ratio, last_u, last_v, geometry):
    """Project the pixels of row ``y`` into the target, from their depth in ``geometry[5]``.

    ``min_depth_ratio``: least fraction of depth kept; ``last_u``, ``last_v``: largest u and v of
    the target. ``geometry`` (6, w) receives u, v, z (0 where out of view), du/dd, dv/dd.
    """
    fx, fy, cx, cy = lenses[0, 0], lenses[0, 1], lenses[0, 2], lenses[0, 3]
    gx = lenses[1, 0]
    gy = lenses[1, 1]
    hx = lenses[1, 2]
    hy = lenses[1, 3]
    ry = (np.float32(y) - cy) / fy
    bx, by, bz = T[0, 1] * ry + T[0, 2], T[1, 1] * ry + T[1, 2], T[2, 1] * ry + T[2, 2]
    for x in range(geometry.shape[1]):
        d = geometry[5, x]
        rx = (np.float32(x) - cx) / fx
        qx, qy, qz = T[0, 0] * rx + bx, T[1, 0] * rx + by, T[2, 0] * rx + bz
        z = d * qz + T[2, 3]
        front = (d > ZERO) & (z > min_depth_ratio * d)
        inverse = ONE / (z if front else ONE)
        px, py = (d * qx + T[0, 3]) * inverse, (d * qy + T[1, 3]) * inverse
        u, v = gx * px + hx, gy * py + hy
        inside = front & (u >= ZERO) & (v >= ZERO) & (u <= last_u) & (v <= last_v)
        geometry[0, x] = u
        geometry[1, x] = v
        geometry[2, x] = z if inside else ZERO
        geometry[3, x] = gx * (qx - px * qz) * inverse
        geometry[4, x] = gy * (qy - py * qz) * inverse


@njit(**PART)
def weight_of(texture, weak):
    """Weight of a pixel by its texture: 1/2 at ``weak``; 1 if that is 0."""
    return texture / (texture + weak) if weak > ZERO else ONE


@njit(**KERNEL)
def warp_rows(
    first, last, depth, rows, row_part, columns, column_part, reference, texture, target,
    target_depth, lenses, T, settings, warped, slope, mask, extra, loss,
):  # fmt: skip
    """Warp the target image through the reference's depth, rows ``first <= y < last``.

    rows, columns (2, n) and their parts: source pixels of the bilinear enlargement; lenses (3, 4):
    fx, fy, cx, cy of the reference, of the target, and of the target at its depth map's size; T
    (3, 4) reference to target; settings: a record of ``PhotoSettings``. ``warped`` is filled from
    the reference where ``mask`` is 0; ``slope`` is d warped / d depth; ``extra`` (3, h, w), unless
    empty, receives the derivatives along x and y and the depth. ``loss[y]`` is the row's sum of the
    weighted L_1.
    """
    height, width = target.shape
    last_u, last_v = np.float32(width - 1), np.float32(height - 1)
    occluded = target_depth.shape[0] > 1
    with_extra = extra.shape[1] > 0
    count = reference.shape[1]
    line = np.empty(depth.shape[1], np.float32)
    geometry = np.empty((6, count), np.float32)
    index = np.empty(count, np.uint32)
    places = np.empty((2, count), np.float32)
    parts = np.empty((2, count), np.float32)
    corners = np.empty((4, count), np.float32)
    for y in range(first, last):
        total = ZERO
        enlarge_line(depth, y, rows, row_part, columns, column_part, line, geometry)
        project_line(y, lenses, T, settings.min_depth_ratio, last_u, last_v, geometry)
        if occluded:
            hide_line(
                target_depth, lenses, settings.occlusion, geometry, places, index, parts, corners
            )
        fetch_corners(target, geometry[0], geometry[1], index, parts, corners)
        sample_line(y, geometry, parts, corners, reference, warped, slope, mask)
        if with_extra:
            for x in range(count):
                extra[0, y, x] = corners[2, x]
                extra[1, y, x] = corners[3, x]
                extra[2, y, x] = geometry[5, x]
        for x in range(reference.shape[1]):
            size = min(abs(warped[y, x] - reference[y, x]), settings.cut)
            small = min(size, settings.huber)
            total += weight_of(texture[y, x], settings.texture) * small * (size - HALF * small)
        loss[y] = settings.l1 / settings.huber * total


@njit(**KERNEL)
def correlate_rows(first, last, reference, texture, warped, mask, half, settings, fields, loss):
    """L_ncc of windows centred in rows ``first <= y < last``, added to ``loss[y]``; its gradient.

    settings as in :func:`warp_rows`. The gradient at a pixel q is the sum over the windows p around
    it of ``fields[0, p] + reference[q] fields[1, p] + warped[q] fields[2, p]``.
    """
    if half < 0:
        return
    height, width = reference.shape
    side = 2 * half + 1
    norm = ONE / np.float32(side * side)
    line = np.empty((6, width), np.float32)
    sums = np.empty((6, width), np.float32)
    for y in range(first, last):
        for x in range(width):
            fields[0, y, x] = fields[1, y, x] = fields[2, y, x] = ZERO
        if y < half or y >= height - half:
            continue
        for c in range(6):
            for x in range(width):
                line[c, x] = sums[c, x] = ZERO
        for r in range(y - half, y + half + 1):
            for x in range(width):
                a, b = reference[r, x], warped[r, x]
                line[0, x] += a
                line[1, x] += a * a
                line[2, x] += b
                line[3, x] += b * b
                line[4, x] += a * b
                line[5, x] += mask[r, x]
        inner = width - side + 1
        for k in range(side):
            for c in range(6):
                for x in range(inner):
                    sums[c, x] += line[c, x + k]
        total = ZERO
        for x in range(inner):
            mean_a, mean_b = norm * sums[0, x], norm * sums[2, x]
            raw_a = max(norm * sums[1, x] - mean_a * mean_a, ZERO)
            raw_b = max(norm * sums[3, x] - mean_b * mean_b, ZERO)
            var_a, var_b = raw_a + settings.variance_floor, raw_b + settings.variance_floor
            inverse = ONE / np.sqrt(var_a * var_b)
            ncc = (norm * sums[4, x] - mean_a * mean_b) * inverse
            used = (raw_a > settings.min_variance) & (ONE - ncc < settings.reject)
            used = used & (norm * sums[5, x] > settings.min_coverage - np.float32(1e-4))
            w = settings.ncc * weight_of(texture[y, x + half], settings.texture) if used else ZERO
            total += w * (ONE - ncc)
            cross = -w * norm * inverse
            own = w * norm * ncc / var_b if raw_b > ZERO else ZERO
            fields[0, y, x + half] = -cross * mean_a - own * mean_b
            fields[1, y, x + half] = cross
            fields[2, y, x + half] = own
        loss[y] += total


@njit(**PART)
def window_sums(y, fields, half, line, sums):
    """Sums of the three fields over the windows around the pixels of row ``y``.

    Does nothing if ``half`` is negative; the test also lets the compiler know that it is not.
    """
    if half < 0:
        return
    height, width = fields.shape[1], fields.shape[2]
    for c in range(3):
        for x in range(line.shape[1]):
            line[c, x] = ZERO
        for r in range(max(y - half, 0), min(y + half + 1, height)):
            for x in range(width):
                line[c, x + half] += fields[c, r, x]
        for x in range(width):
            sums[c, x] = ZERO
        for k in range(2 * half + 1):
            for x in range(width):
                sums[c, x] += line[c, x + k]


@njit(**KERNEL)
def depth_gradient_rows(
    first, last, rows, row_part, columns, column_part, reference, texture, warped, slope, mask,
    half, settings, fields, g_image, g_depth,
):  # fmt: skip
    """d loss / d depth for the depth rows ``first <= y < last``: the enlargement's adjoint.

    settings as in :func:`warp_rows`; ``half`` is negative without correlation. ``g_image``
    unless empty: [0] is added to d loss / d warped, [1] receives the sum. Image rows that feed two
    spans are computed in both.
    """
    height, width = reference.shape
    line = np.empty((3, width + 2 * max(half, 0)), np.float32)
    sums = np.zeros((3, width), np.float32)
    pull = np.zeros((last - first, width), np.float32)
    for y in range(height):
        i = rows[0, y] - first
        k = rows[1, y] - first
        f = row_part[y]
        own_i, own_k = 0 <= i < last - first, 0 <= k < last - first
        if not (own_i or own_k):
            continue
        window_sums(y, fields, half, line, sums)
        for x in range(width):
            a, b = reference[y, x], warped[y, x]
            near = abs(b - a) < settings.cut
            push = min(max((b - a) / settings.huber, -ONE), ONE) if near else ZERO
            push *= settings.l1 * weight_of(texture[y, x], settings.texture)
            sums[0, x] += a * sums[1, x] + b * sums[2, x] + push
        if g_image.shape[1] > 0:
            for x in range(width):
                sums[0, x] += g_image[0, y, x]
                g_image[1, y, x] = sums[0, x] * mask[y, x]
        # The slope is 0 outside the mask.
        for x in range(width):
            sums[0, x] *= slope[y, x]
        if own_i:
            for x in range(width):
                pull[i, x] += (ONE - f) * sums[0, x]
        if own_k:
            for x in range(width):
                pull[k, x] += f * sums[0, x]
        if half < 0:
            for x in range(width):
                sums[0, x] = ZERO
    for r in range(last - first):
        for x in range(g_depth.shape[1]):
            g_depth[first + r, x] = ZERO
        for x in range(width):
            f = column_part[x]
            g_depth[first + r, columns[0, x]] += (ONE - f) * pull[r, x]
            g_depth[first + r, columns[1, x]] += f * pull[r, x]


@njit(**KERNEL)
def pose_gradient_rows(first, last, g_image, extra, lenses, T, g_T):
    """d loss / d T (12 numbers of the 3x4 matrix) of each row ``first <= y < last``."""
    fx, fy, cx, cy = lenses[0, 0], lenses[0, 1], lenses[0, 2], lenses[0, 3]
    for y in range(first, last):
        for k in range(12):
            g_T[y, k] = 0.0
        for x in range(g_image.shape[2]):
            g = g_image[1, y, x]
            du = g * extra[0, y, x]
            dv = g * extra[1, y, x]
            d = extra[2, y, x]
            if du == ZERO and dv == ZERO:
                continue
            X = d * (np.float32(x) - cx) / fx
            Y = d * (np.float32(y) - cy) / fy
            inverse = ONE / (T[2, 0] * X + T[2, 1] * Y + T[2, 2] * d + T[2, 3])
            px = (T[0, 0] * X + T[0, 1] * Y + T[0, 2] * d + T[0, 3]) * inverse
            py = (T[1, 0] * X + T[1, 1] * Y + T[1, 2] * d + T[1, 3]) * inverse
            gx, gy = lenses[1, 0] * du * inverse, lenses[1, 1] * dv * inverse
            gz = -gx * px - gy * py
            for k in range(3):
                s = gx if k == 0 else (gy if k == 1 else gz)
                g_T[y, 4 * k] += s * X
                g_T[y, 4 * k + 1] += s * Y
                g_T[y, 4 * k + 2] += s * d
                g_T[y, 4 * k + 3] += s
