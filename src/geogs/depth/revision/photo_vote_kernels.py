"""Compiled loops of the photometric costs of depths: of single pixels, and their means.

Arrays are float32 and C-contiguous; every kernel releases the interpreter lock.
"""

import numpy as np
from numba import njit

from geogs.kernel_parts import inlined

_FAST = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
"""NaN must compare as NaN."""
_PART = inlined(_FAST)
ZERO, ONE = np.float32(0), np.float32(1)


@njit(**_PART)
def project_row(T, lens, y, depth, place):
    """Projections of row ``y`` of a depth map into a neighbour: ``place`` (2, w) receives u and v,
    NaN behind the neighbour.

    ``T`` (3, 4) takes the reference's frame to the neighbour's; ``lens`` has fx, fy, cx, cy.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    ry = (np.float32(y) - cy) / fy
    row = depth[y]
    u = place[0]
    v = place[1]
    for x in range(row.shape[0]):
        z0 = row[x]
        rx = (np.float32(np.int32(x)) - cx) / fx
        px, py = z0 * rx, z0 * ry
        z = t20 * px + t21 * py + t22 * z0 + t23
        inverse = ONE / max(z, np.float32(1e-9)) if z > ZERO else np.float32(np.nan)
        u[x] = fx * (t00 * px + t01 * py + t02 * z0 + t03) * inverse + cx
        v[x] = fy * (t10 * px + t11 * py + t12 * z0 + t13) * inverse + cy


@njit(**_PART)
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
    upper = p[left] + a * (p[right] - p[left])
    lower = q[left] + a * (q[right] - q[left])
    return upper + b * (lower - upper)


@njit(**_FAST)
def grey_differences(reference, images, T, lens, depth, differences):
    """Grey values of the neighbours (n, h, w) at each pixel's projection less the reference's; NaN
    outside and where there is no depth."""
    place = np.empty((2, depth.shape[1]), np.float32)
    for n in range(images.shape[0]):
        for y in range(depth.shape[0]):
            project_row(T[n], lens, y, depth, place)
            for x in range(depth.shape[1]):
                seen = np.float32(np.nan)
                if depth[y, x] > ZERO:
                    seen = grey_at(images[n], place[0, x], place[1, x])
                differences[n, y, x] = seen - reference[y, x]


@njit(**_PART)
def better_half(costs, count):
    """Mean of the lower half, rounded up, of the first ``count`` costs; 1 of none. Sorts them."""
    if count == 0:
        return ONE
    for i in range(1, count):
        value = costs[i]
        k = i
        while k > 0 and costs[k - 1] > value:
            costs[k] = costs[k - 1]
            k -= 1
        costs[k] = value
    half = (count + 1) // 2
    total = ZERO
    for i in range(half):
        total += costs[i]
    return total / np.float32(half)


@njit(**_FAST)
def pixel_costs(differences, offset, limit, mask, cost):
    """Costs of the pixels of a ``mask`` from grey differences (n, h, w) less ``offset`` (n), cut at
    ``limit`` (n), which counts as 1; 1 outside the mask.
    """
    costs = np.empty(differences.shape[0], np.float32)
    for y in range(cost.shape[0]):
        for x in range(cost.shape[1]):
            count = 0
            for n in range(differences.shape[0] if mask[y, x] else 0):
                difference = differences[n, y, x]
                if not np.isnan(difference):
                    costs[count] = min(abs(difference - offset[n]) / limit[n], ONE)
                    count += 1
            cost[y, x] = better_half(costs, count)


@njit(**_FAST)
def average_costs(costs, mask, guide, radius, contrast, mean):
    """Means of two costs (2, h, w) around each pixel of a ``mask``, weighted by likeness in colour;
    0 outside the mask.

    ``guide`` is (h, w, 3); the border repeats. A mean colour difference of ``contrast`` makes a
    weight of 1 / e.
    """
    height, width = mask.shape
    fall = -ONE / (np.float32(3) * contrast)
    for y in range(height):
        for x in range(width):
            mean[0, y, x] = ZERO
            mean[1, y, x] = ZERO
            if not mask[y, x]:
                continue
            first = ZERO
            second = ZERO
            weights = ZERO
            for dy in range(-radius, radius + 1):
                v = min(max(y + dy, 0), height - 1)
                for dx in range(-radius, radius + 1):
                    u = min(max(x + dx, 0), width - 1)
                    apart = abs(guide[v, u, 0] - guide[y, x, 0])
                    apart += abs(guide[v, u, 1] - guide[y, x, 1])
                    apart += abs(guide[v, u, 2] - guide[y, x, 2])
                    weight = np.exp(apart * fall)
                    first += weight * costs[0, v, u]
                    second += weight * costs[1, v, u]
                    weights += weight
            mean[0, y, x] = first / weights
            mean[1, y, x] = second / weights
