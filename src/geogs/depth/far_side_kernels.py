"""Compiled loops of the far side of edges: what lies beyond a pixel, and whom the images speak for.

The same as :func:`geogs.depth.far_side.farther_surface` and
:func:`geogs.depth.photo_vote.photo_vote`, but only where there is something beyond, and of no other
pixel. Arrays are float32 and C-contiguous; every kernel releases the interpreter lock.
"""

import numpy as np
from numba import njit

_FAST = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
"""NaN must compare as NaN."""
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)


@njit(**_FAST)
def goes_on(planes, v, u, dy, dx, farthest, most):
    """Inverse depth of the plane of pixel (v + dy, u + dx) at (v, u), or 0 where it is none that
    lies between ``farthest`` and ``most``. ``planes`` (3, h, w): inverse depth and its slopes."""
    y, x = v + dy, u + dx
    if y < 0 or x < 0 or y >= planes.shape[1] or x >= planes.shape[2] or planes[0, y, x] <= ZERO:
        return ZERO
    here = planes[0, y, x] - np.float32(dx) * planes[1, y, x] - np.float32(dy) * planes[2, y, x]
    return here if (here >= farthest) & (here < most) else ZERO


@njit(**_FAST)
def farther_planes(planes, farthest, near_share, reach, found):
    """Planes of farther surfaces within ``reach`` pixels, gone on from pixel to pixel.

    A surface is farther whose inverse depth at a pixel is below ``near_share`` of its own.
    ``found`` (3, h, w), zero on entry, receives inverse depth and slopes. Round by round only what
    the last one has found can add anything: all else has been asked.
    """
    height, width = found.shape[1], found.shape[2]
    age = np.zeros((height, width), np.int32)
    for round in range(1, reach + 1):
        any_new = False
        for v in range(height):
            for u in range(width):
                if age[v, u] > 0:
                    continue
                most = near_share * planes[0, v, u]
                for step in range(9):
                    dy, dx = step // 3 - 1, step % 3 - 1
                    if step == 4:
                        continue
                    y, x = v + dy, u + dx
                    if round == 1:
                        here, source = goes_on(planes, v, u, dy, dx, farthest, most), planes
                    else:
                        if y < 0 or x < 0 or y >= height or x >= width or age[y, x] != round - 1:
                            continue
                        here, source = goes_on(found, v, u, dy, dx, farthest, most), found
                    if here > ZERO:
                        found[0, v, u] = here
                        found[1, v, u], found[2, v, u] = source[1, y, x], source[2, y, x]
                        age[v, u] = round
                        any_new = True
                        break
        if not any_new:
            break


@njit(**_FAST)
def project_row(T, lens, y, depth, place):
    """Where a neighbour sees the pixels of row ``y`` of a depth map: ``place`` (2, w) receives u
    and v, and NaN for both where that is behind the neighbour.

    ``T`` (3, 4) takes the reference's frame to the neighbour's; ``lens`` has fx, fy, cx, cy.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    ry = (np.float32(y) - cy) / fy
    row, u, v = depth[y], place[0], place[1]
    for x in range(row.shape[0]):
        z0, rx = row[x], (np.float32(np.int32(x)) - cx) / fx
        px, py = z0 * rx, z0 * ry
        z = t20 * px + t21 * py + t22 * z0 + t23
        inverse = ONE / max(z, np.float32(1e-9)) if z > ZERO else np.float32(np.nan)
        u[x] = fx * (t00 * px + t01 * py + t02 * z0 + t03) * inverse + cx
        v[x] = fy * (t10 * px + t11 * py + t12 * z0 + t13) * inverse + cy


@njit(**_FAST)
def grey_at(image, u, v):
    """Bilinear grey value at (u, v); NaN outside."""
    height, width = image.shape
    last_u, last_v = np.float32(width - 1), np.float32(height - 1)
    if not ((u >= ZERO) & (v >= ZERO) & (u <= last_u) & (v <= last_v)):
        return np.float32(np.nan)
    i, j = min(np.int32(u), np.int32(width - 2)), min(np.int32(v), np.int32(height - 2))
    a, b = u - np.float32(i), v - np.float32(j)
    p, q = image[np.uint32(j)], image[np.uint32(j + 1)]
    left, right = np.uint32(i), np.uint32(i + 1)
    upper, lower = p[left] + a * (p[right] - p[left]), q[left] + a * (q[right] - q[left])
    return upper + b * (lower - upper)


@njit(**_FAST)
def grey_differences(reference, images, T, lens, depth, differences):
    """Grey value of each neighbour (n, h, w) where it sees a pixel, less the reference's; NaN where
    it sees it not, or there is no depth."""
    place = np.empty((2, depth.shape[1]), np.float32)
    for n in range(images.shape[0]):
        for y in range(depth.shape[0]):
            project_row(T[n], lens, y, depth, place)
            for x in range(depth.shape[1]):
                seen = np.float32(np.nan)
                if depth[y, x] > ZERO:
                    seen = grey_at(images[n], place[0, x], place[1, x])
                differences[n, y, x] = seen - reference[y, x]


@njit(**_FAST)
def better_half(costs, count):
    """Mean of the lower half, rounded up, of the first ``count`` costs; 1 of none. Sorts them."""
    if count == 0:
        return ONE
    for i in range(1, count):
        value, k = costs[i], i
        while k > 0 and costs[k - 1] > value:
            costs[k] = costs[k - 1]
            k -= 1
        costs[k] = value
    half, total = (count + 1) // 2, ZERO
    for i in range(half):
        total += costs[i]
    return total / np.float32(half)


@njit(**_FAST)
def cost_gains(differences, others, beyond, light, most, gain):
    """How much less it costs by the images what is beyond, of the grey differences of either.

    ``light`` (n) is taken off the differences (n, h, w), and ``most`` (n) counts as 1. The gain is
    0 where there is nothing beyond.
    """
    costs = np.empty(differences.shape[0], np.float32)
    for y in range(beyond.shape[0]):
        for x in range(beyond.shape[1]):
            gain[y, x] = ZERO
            if not beyond[y, x] > ZERO:
                continue
            for which in range(2):
                count = 0
                for n in range(differences.shape[0]):
                    difference = differences[n, y, x] if which == 0 else others[n, y, x]
                    if not np.isnan(difference):
                        costs[count] = min(abs(difference - light[n]) / most[n], ONE)
                        count += 1
                cost = better_half(costs, count)
                gain[y, x] += cost if which == 0 else -cost


@njit(**_FAST)
def average_gains(gain, beyond, guide, radius, contrast, vote):
    """Mean of the gains around each pixel with something beyond, by likeness in colour.

    ``guide`` (h, w, 3); the border repeats. A mean difference of the colours of ``contrast`` makes
    a weight of 1 / e.
    """
    height, width = gain.shape
    fall = -ONE / (np.float32(3) * contrast)
    for y in range(height):
        for x in range(width):
            vote[y, x] = ZERO
            if not beyond[y, x] > ZERO:
                continue
            total, weights = ZERO, ZERO
            for dy in range(-radius, radius + 1):
                v = min(max(y + dy, 0), height - 1)
                for dx in range(-radius, radius + 1):
                    u = min(max(x + dx, 0), width - 1)
                    apart = abs(guide[v, u, 0] - guide[y, x, 0])
                    apart += abs(guide[v, u, 1] - guide[y, x, 1])
                    apart += abs(guide[v, u, 2] - guide[y, x, 2])
                    weight = np.exp(apart * fall)
                    total += weight * gain[v, u]
                    weights += weight
            vote[y, x] = total / weights
