"""Compiled loop of the test at depth edges: assigns each pixel to one of the surfaces around it.

Arrays are float32 and C-contiguous: maps (h, w), the colour guide (3, h, w), costs (h, w, planes).
The kernel releases the interpreter lock and processes the rows from ``first`` to before ``last``.
"""

import numpy as np
from numba import njit

from geogs.kernel_parts import inlined

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
_PART = inlined(_FAST)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)


@njit(**_PART)
def _cost_at(costs, first, spacing, rho):
    """Matching cost of one pixel, interpolated between planes; beyond the ends, the end's."""
    last = costs.shape[0] - 1
    place = min(max((rho - first) / spacing, ZERO), np.float32(last))
    k = min(int(place), last - 1)
    return costs[k] + (place - np.float32(k)) * (costs[k + 1] - costs[k])


@njit(**_PART)
def _add_sides(
    y, v, dx, first, last, rho, slope_x, slope_y, confidence, guide, contrast, gap, sums
):
    """Votes of the pixels (dx, v - y) away on the pixels ``first`` to ``last`` of row y.

    Adds to ``sums`` (5, w) the weights of pixels of the same surface, of farther and of nearer
    ones, and the weighted inverse depths of the farther and of the nearer ones.
    """
    # Views, because an index that could be negative would keep the loop from vectorising.
    own = rho[y, first:last]
    there = rho[v, first + dx : last + dx]
    gx, gy = slope_x[v, first + dx : last + dx], slope_y[v, first + dx : last + dx]
    conf = confidence[v, first + dx : last + dx]
    g0, g1, g2 = guide[0, y, first:last], guide[1, y, first:last], guide[2, y, first:last]
    k0, k1 = guide[0, v, first + dx : last + dx], guide[1, v, first + dx : last + dx]
    k2 = guide[2, v, first + dx : last + dx]
    same = sums[0, first:last]
    far = sums[1, first:last]
    near = sums[2, first:last]
    far_sum = sums[3, first:last]
    near_sum = sums[4, first:last]
    right, down = np.float32(dx), np.float32(v - y)
    low, high = ONE - gap, ONE + gap
    for x in range(last - first):
        d0, d1, d2 = k0[x] - g0[x], k1[x] - g1[x], k2[x] - g2[x]
        like = ONE + contrast * (d0 * d0 + d1 * d1 + d2 * d2)
        value = there[x] - gx[x] * right - gy[x] * down
        weight = conf[x] / (like * like)
        is_far = value <= own[x] * low
        is_near = value >= own[x] * high
        of_far = weight if is_far & (value > ZERO) else ZERO
        of_near = weight if is_near else ZERO
        same[x] += ZERO if is_far | is_near else weight
        far[x] += of_far
        near[x] += of_near
        far_sum[x] += of_far * value
        near_sum[x] += of_near * value


@njit(**_PART)
def _around(y, x, rho, slope_x, slope_y, confidence, guide, reach, contrast, samples):
    """Extend the planes of the pixels around to (x, y); return their number.

    ``samples`` (5, n) receives inverse depth, its slopes, weight and confidence of each.
    """
    h, w = rho.shape
    count = 0
    c0, c1, c2 = guide[0, y, x], guide[1, y, x], guide[2, y, x]
    for v in range(max(y - reach, 0), min(y + reach + 1, h)):
        for u in range(max(x - reach, 0), min(x + reach + 1, w)):
            d0, d1, d2 = guide[0, v, u] - c0, guide[1, v, u] - c1, guide[2, v, u] - c2
            like = ONE + contrast * (d0 * d0 + d1 * d1 + d2 * d2)
            right, down = np.float32(u - x), np.float32(v - y)
            samples[0, count] = rho[v, u] - slope_x[v, u] * right - slope_y[v, u] * down
            samples[1, count] = slope_x[v, u]
            samples[2, count] = slope_y[v, u]
            samples[3, count] = confidence[v, u] / (like * like)
            samples[4, count] = confidence[v, u]
            count += 1
    return count


@njit(**_PART)
def _mode(samples, count, low, high, start, width, rounds, mode):
    """Mean plane of the samples with inverse depth between ``low`` and ``high`` near their mode.

    Mean shift from ``start`` with Cauchy's kernel of relative ``width``. ``mode`` receives inverse
    depth, slopes and confidence; returns their weight.
    """
    centre = start
    total = ZERO
    across = down = conf = ZERO
    for _ in range(rounds):
        inverse = ONE / (width * centre)
        total = place = across = down = conf = ZERO
        for i in range(count):
            value = samples[0, i]
            away = (value - centre) * inverse
            is_within = (low < value) & (value < high)
            weight = samples[3, i] / (ONE + away * away) if is_within else ZERO
            total += weight
            place += weight * value
            across += weight * samples[1, i]
            down += weight * samples[2, i]
            conf += weight * samples[4, i]
        scale = ONE / max(total, np.float32(1e-12))
        centre = place * scale
        across = across * scale
        down = down * scale
        conf = conf * scale
    mode[0] = centre
    mode[1] = across
    mode[2] = down
    mode[3] = conf
    return total


@njit(**_FAST)
def resolve_edges(
    first, last, rho, slope_x, slope_y, confidence, guide, costs, plane, spacing, reach, contrast,
    gap, width, trust, rounds, moved, new_rho, new_x, new_y, new_confidence,
):  # fmt: skip
    """Give each pixel the plane favoured by like-coloured pixels around it and its matching cost.

    Candidates are the modes of the pixels that are farther and nearer by a relative ``gap``; the
    others are of the pixel's own surface. A candidate's score is the log ratio of its weight to the
    own surface's plus ``trust`` times how much less its matching cost is; the best above 0 is
    taken, with ``moved`` times the mean confidence of its voters. The weights of both sides are
    summed row by row; only pixels that they could move are examined one by one.
    """
    h, w = rho.shape
    samples = np.empty((5, (2 * reach + 1) ** 2), np.float32)
    mode = np.empty(4, np.float32)
    sums = np.empty((5, w), np.float32)
    little = np.float32(0.1)
    enough = np.float32(0.3)
    for y in range(first, last):
        sums[:] = ZERO
        for v in range(max(y - reach, 0), min(y + reach + 1, h)):
            for dx in range(-reach, reach + 1):
                _add_sides(
                    y, v, dx, max(0, -dx), min(w, w - dx), rho, slope_x, slope_y, confidence,
                    guide, contrast, gap, sums,
                )  # fmt: skip
        for x in range(w):
            own = rho[y, x]
            same = sums[0, x]
            new_rho[y, x] = own
            new_x[y, x] = slope_x[y, x]
            new_y[y, x] = slope_y[y, x]
            new_confidence[y, x] = confidence[y, x]
            if max(sums[1, x], sums[2, x]) < enough:
                continue
            far, near = own * (ONE - gap), own * (ONE + gap)
            best = ZERO
            count = 0
            here = _cost_at(costs[y, x], plane, spacing, own)
            for side in range(2):
                weight = sums[1 + side, x]
                if weight < enough:
                    continue
                if np.log((weight + little) / (same + little)) + trust * here < best:
                    continue  # even with all of that weight and no cost
                if count == 0:
                    count = _around(
                        y, x, rho, slope_x, slope_y, confidence, guide, reach, contrast, samples
                    )
                low, high = (ZERO, far) if side == 0 else (near, np.float32(1e30))
                start = sums[3 + side, x] / weight
                weight = _mode(samples, count, low, high, start, width, rounds, mode)
                if weight < enough:
                    continue
                gain = here - _cost_at(costs[y, x], plane, spacing, mode[0])
                score = np.log((weight + little) / (same + little)) + trust * gain
                if score > best:
                    best = score
                    new_rho[y, x] = mode[0]
                    new_x[y, x] = mode[1]
                    new_y[y, x] = mode[2]
                    new_confidence[y, x] = moved * mode[3]
