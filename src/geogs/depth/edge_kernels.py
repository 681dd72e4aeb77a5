"""Compiled loop of the test at depth edges: which of the surfaces around a pixel it belongs to.

Arrays are float32 and C-contiguous: maps (h, w), the colour guide (3, h, w), costs (h, w, planes).
The kernel releases the interpreter lock and does the rows from the first to before the last alone.
"""

import numpy as np
from numba import njit

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ZERO = np.float32(0.0)
ONE = np.float32(1.0)


@njit(**_FAST)
def _cost_at(costs, first, spacing, rho):
    """Matching cost of one pixel, interpolated between planes; at the ends the last one's."""
    last = costs.shape[0] - 1
    place = min(max((rho - first) / spacing, ZERO), np.float32(last))
    k = min(int(place), last - 1)
    return costs[k] + (place - np.float32(k)) * (costs[k + 1] - costs[k])


@njit(**_FAST)
def _around(y, x, rho, slope_x, slope_y, confidence, guide, reach, contrast, samples):
    """Planes of the pixels around, extended to (x, y), with their weights; how many there are.

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


@njit(**_FAST)
def _mode(samples, count, low, high, start, width, rounds, mode):
    """Mean plane of the samples with inverse depth between ``low`` and ``high`` near their mode.

    Mean shift from ``start`` with Cauchy's kernel of relative ``width``. ``mode`` receives inverse
    depth, slopes and confidence; returns the weight behind it.
    """
    mode[0] = start
    total = ZERO
    for _ in range(rounds):
        total = ZERO
        centre, inverse = mode[0], ONE / (width * mode[0])
        mode[:] = ZERO
        for i in range(count):
            value = samples[0, i]
            if low < value < high:
                away = (value - centre) * inverse
                weight = samples[3, i] / (ONE + away * away)
                total += weight
                mode[0] += weight * value
                mode[1] += weight * samples[1, i]
                mode[2] += weight * samples[2, i]
                mode[3] += weight * samples[4, i]
        scale = ONE / max(total, np.float32(1e-12))
        for k in range(4):
            mode[k] *= scale
    return total


@njit(**_FAST)
def resolve_edges(
    first, last, rho, slope_x, slope_y, confidence, guide, costs, plane, spacing, reach, contrast,
    apart, width, trust, rounds, moved, new_rho, new_x, new_y, new_confidence,
):  # fmt: skip
    """Give each pixel the plane that those of like colour around it and its matching cost favour.

    Candidates are the modes of what is farther and what is nearer by a relative ``apart``; less
    apart is the pixel's own surface. A candidate's score is the log ratio of its weight to the own
    surface's plus ``trust`` times how much less its matching cost is; the best above 0 is taken,
    with ``moved`` times the mean confidence of those that are for it.
    """
    size = (2 * reach + 1) ** 2
    samples = np.empty((5, size), np.float32)
    mode = np.empty(4, np.float32)
    weights, sums = np.empty(2, np.float32), np.empty(2, np.float32)
    little, enough = np.float32(0.1), np.float32(0.3)
    for y in range(first, last):
        for x in range(rho.shape[1]):
            own = rho[y, x]
            new_rho[y, x], new_x[y, x], new_y[y, x] = own, slope_x[y, x], slope_y[y, x]
            new_confidence[y, x] = confidence[y, x]
            count = _around(
                y, x, rho, slope_x, slope_y, confidence, guide, reach, contrast, samples
            )
            far, near = own * (ONE - apart), own * (ONE + apart)
            same = ZERO
            weights[:] = ZERO
            sums[:] = ZERO
            for i in range(count):
                value, weight = samples[0, i], samples[3, i]
                if value <= far or value >= near:
                    side = 0 if value <= far else 1
                    if value > ZERO:
                        weights[side] += weight
                        sums[side] += weight * value
                else:
                    same += weight
            best = ZERO
            here = _cost_at(costs[y, x], plane, spacing, own)
            for side in range(2):
                if weights[side] < enough:
                    continue
                if np.log((weights[side] + little) / (same + little)) + trust * here < best:
                    continue  # even with all of that weight and no cost
                low, high = (ZERO, far) if side == 0 else (near, np.float32(1e30))
                start = sums[side] / weights[side]
                weight = _mode(samples, count, low, high, start, width, rounds, mode)
                if weight < enough:
                    continue
                gain = here - _cost_at(costs[y, x], plane, spacing, mode[0])
                score = np.log((weight + little) / (same + little)) + trust * gain
                if score > best:
                    best = score
                    new_rho[y, x], new_x[y, x], new_y[y, x] = mode[0], mode[1], mode[2]
                    new_confidence[y, x] = moved * mode[3]
