"""Compiled loops of the plane sweep: matching cost, semi-global aggregation, winner.

Images are (h, w); cost volumes are (h, w, planes), so that the innermost loops run over planes with
unit stride. All arrays are float32 and C-contiguous. Every kernel releases the interpreter lock;
those with parameters ``first`` and ``last`` process the rows from ``first`` to before ``last``.
"""

import numpy as np
from numba import njit

from geogs.depth.sampling_kernels import fetch_pairs
from geogs.kernel_parts import inlined

BLOCK = 16
"""Planes matched before their costs are transposed into the volume: one cache line of float32."""
STRIP = 32
"""Rows matched at a time, so that all buffers stay in the first cache levels."""
FAR = np.float32(1e9)
OUTSIDE = np.float32(1.2)
"""Cost of a sample outside the neighbour, a little more than that of no similarity (1)."""

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
_PART = inlined(_FAST)


@njit(**_PART)
def _warp_row(pairs, a, b, rho, y, radius, warped, lowest, index, fraction_u, fraction_v, top, low):
    """Sample an image where row ``y`` of the plane of inverse depth ``rho`` projects.

    ``pairs`` are its ``pixel_pairs``. Homogeneous pixel q = a p + rho b. ``warped`` receives the
    samples with ``radius`` repeats of the first and last on either side. ``lowest``, the least cost
    a pixel may get, is OUTSIDE where the sample leaves the image and 0 elsewhere. The loop over x
    is split so that all but the copying of samples (``top`` and ``low`` are scratch) vectorises.
    """
    h, w = pairs.shape
    last_u, last_v = np.float32(w - 1.001), np.float32(h - 1.001)
    s0, s1, s2 = np.float32(a[0, 0]), np.float32(a[1, 0]), np.float32(a[2, 0])
    c0 = np.float32(a[0, 1] * y + a[0, 2] + rho * b[0])
    c1 = np.float32(a[1, 1] * y + a[1, 2] + rho * b[1])
    c2 = np.float32(a[2, 1] * y + a[2, 2] + rho * b[2])
    count = index.shape[0]
    for x in range(count):
        column = np.float32(np.int32(x))
        q2 = c2 + s2 * column
        inverse = np.float32(1.0) / max(q2, np.float32(1e-3))
        u = (c0 + s0 * column) * inverse
        v = (c1 + s1 * column) * inverse
        cu = min(max(u, np.float32(0.0)), last_u)
        cv = min(max(v, np.float32(0.0)), last_v)
        gone = abs(cu - u) + abs(cv - v) + max(np.float32(1e-3) - q2, np.float32(0.0))
        lowest[x] = OUTSIDE if gone > np.float32(0.0) else np.float32(0.0)
        whole_u, whole_v = np.floor(cu), np.floor(cv)
        fraction_u[x] = cu - whole_u
        fraction_v[x] = cv - whole_v
        index[x] = np.uint32(np.int32(whole_v * np.float32(w) + whole_u))
    fetch_pairs(pairs, index, top, low)
    upper = top.view(np.float32)
    lower = low.view(np.float32)
    own = warped[radius:]
    for x in range(count):
        above = upper[2 * x] + fraction_u[x] * (upper[2 * x + 1] - upper[2 * x])
        below = lower[2 * x] + fraction_u[x] * (lower[2 * x + 1] - lower[2 * x])
        own[x] = above + fraction_v[x] * (below - above)
    for i in range(radius):
        warped[i] = warped[radius]
        warped[radius + count + i] = warped[radius + count - 1]


@njit(**_PART)
def _row_sums(reference, warped, radius, i, sums):
    """Sums of b, b^2 and a b over 2 radius + 1 columns into row ``i`` of each of the ``sums``; rows
    have ``radius`` repeats a side."""
    ones = sums[0, i]
    squares = sums[1, i]
    products = sums[2, i]
    for x in range(ones.shape[0]):
        b0, b1, b2 = warped[x], warped[x + 1], warped[x + 2]
        ones[x] = b0 + b1 + b2
        squares[x] = b0 * b0 + b1 * b1 + b2 * b2
        products[x] = b0 * reference[x] + b1 * reference[x + 1] + b2 * reference[x + 2]
    for k in range(3, 2 * radius + 1):
        for x in range(ones.shape[0]):
            b = warped[x + k]
            ones[x] += b
            squares[x] += b * b
            products[x] += b * reference[x + k]


@njit(**_PART)
def _column_sums(rows, first, radius, out):
    """Sums of 2 radius + 1 rows from the ``first`` on."""
    r0, r1, r2 = rows[first], rows[first + 1], rows[first + 2]
    for x in range(out.shape[0]):
        out[x] = r0[x] + r1[x] + r2[x]
    for i in range(first + 3, first + 2 * radius + 1):
        row = rows[i]
        for x in range(out.shape[0]):
            out[x] += row[x]


@njit(**_PART)
def _ncc_row(sums, mean, scale, lowest, norm, floor, best):
    """1 - NCC from the window sums, inserted into the sorted smallest costs ``best`` (keep, w).

    ``scale`` is 1 / sqrt(variance + floor) of the reference windows, which reduces the similarity
    of textureless windows to nothing.
    """
    keep = best.shape[0]
    sum_b = sums[0]
    sum_bb = sums[1]
    sum_ab = sums[2]
    for x in range(sum_b.shape[0]):
        m = sum_b[x] * norm
        spread = max(sum_bb[x] * norm - m * m, np.float32(0.0)) + floor
        ncc = (sum_ab[x] * norm - mean[x] * m) * scale[x] / np.sqrt(spread)
        sum_b[x] = max(min(np.float32(1.0) - ncc, OUTSIDE), lowest[x])
    for k in range(keep):
        row = best[k]
        for x in range(sum_b.shape[0]):
            b, c = row[x], sum_b[x]
            row[x] = min(b, c)
            sum_b[x] = max(b, c)


@njit(**_PART)
def _count_inside(lowest, seen):
    """Increase the counts ``seen`` where the sample lies in the image."""
    for x in range(seen.shape[0]):
        seen[x] += np.int32(lowest[x] < OUTSIDE)


@njit(**_PART)
def _mean_of_better_half(sorted_costs, seen, least, out):
    """Mean of the smallest costs: half as many as ``seen`` neighbours, rounded up, or ``least``."""
    keep, w = sorted_costs.shape
    for x in range(w):
        out[x] = np.float32(0.0)
    for k in range(keep):
        row = sorted_costs[k]
        for x in range(w):
            count = max((seen[x] + np.int32(1)) >> np.int32(1), least)
            out[x] += row[x] if k < count else np.float32(0.0)
    for x in range(w):
        out[x] /= np.float32(max((seen[x] + np.int32(1)) >> np.int32(1), least))


@njit(**_PART)
def _transpose(block, count, volume, start):
    """volume[x, start + k] = block[k, x] for k below ``count``."""
    for x in range(volume.shape[0]):
        for k in range(count):
            volume[x, start + k] = block[k, x]


@njit(**_FAST)
def match_planes(first, last, reference, mean, scale, pairs, a, b, planes, radius, floor, volume):
    """volume[y, x, k] = mean of the smaller half of 1 - NCC over the neighbours, at plane k.

    That is half of those into whose images the pixel falls, rounded up, but at least two (one if
    there is only one), so a pixel that few see is matched with these; a missing one costs OUTSIDE.
    ``pairs`` (n, h, w) are the ``pixel_pairs`` of the neighbours; ``a`` (n, 3, 3), ``b`` (n, 3):
    their homographies a + rho b e_3^T (float64). Windows have (2 radius + 1)^2 pixels; image
    borders repeat: ``reference`` has ``radius`` more columns a side that do. Images should be
    centred about zero, so that little is lost to cancellation in the variances.
    """
    h, w = mean.shape
    warped = np.empty(w + 2 * radius, np.float32)
    lowest = np.empty((STRIP + 2 * radius, w), np.float32)
    index = np.empty(w, np.uint32)
    fraction_u, fraction_v = np.empty(w, np.float32), np.empty(w, np.float32)
    top = np.empty(w, np.uint64)
    low = np.empty(w, np.uint64)
    rows_of = np.empty((3, STRIP + 2 * radius, w), np.float32)
    sums = np.empty((3, w), np.float32)
    least = np.int32(min(2, pairs.shape[0]))
    keep = max(least, (pairs.shape[0] + 1) // 2)
    best = np.empty((STRIP, keep, w), np.float32)
    seen = np.empty((STRIP, w), np.int32)
    block = np.empty((STRIP, BLOCK, w), np.float32)
    norm = np.float32(1.0 / (2 * radius + 1) ** 2)
    for y0 in range(first, last, STRIP):
        rows = min(STRIP, last - y0)
        for start in range(0, planes.shape[0], BLOCK):
            count = min(BLOCK, planes.shape[0] - start)
            for k in range(count):
                best[:] = FAR
                seen[:] = 0
                for j in range(pairs.shape[0]):
                    for i in range(rows + 2 * radius):
                        y = min(max(y0 + i - radius, 0), h - 1)
                        _warp_row(
                            pairs[j], a[j], b[j], planes[start + k], y, radius, warped, lowest[i],
                            index, fraction_u, fraction_v, top, low,
                        )  # fmt: skip
                        _row_sums(reference[y], warped, radius, i, rows_of)
                    for i in range(rows):
                        y = y0 + i
                        for s in range(3):
                            _column_sums(rows_of[s], i, radius, sums[s])
                        least_cost = lowest[i + radius]
                        _ncc_row(sums, mean[y], scale[y], least_cost, norm, floor, best[i])
                        _count_inside(least_cost, seen[i])
                for i in range(rows):
                    _mean_of_better_half(best[i], seen[i], least, block[i, k])
            for i in range(rows):
                _transpose(block[i], count, volume[y0 + i], start)


@njit(**_PART)
def _likeness_of_row(guide, y, v, dx, contrast, weights):
    """1 / (1 + contrast |dI|^2)^2 of the pixels of row ``y`` and those (dx, v - y) away; 0 where
    there is none."""
    w = guide.shape[1]
    first = max(0, -dx)
    last = min(w, w - dx)
    one = np.float32(1.0)
    weights[:first] = np.float32(0.0)
    weights[last:] = np.float32(0.0)
    # Views, because an index that could be negative would keep the loop from vectorising.
    here = guide[y, first:last]
    there = guide[v, first + dx : last + dx]
    out = weights[first:last]
    for x in range(last - first):
        red = here[x, 0] - there[x, 0]
        green = here[x, 1] - there[x, 1]
        blue = here[x, 2] - there[x, 2]
        like = one + contrast * (red * red + green * green + blue * blue)
        out[x] = one / (like * like)


@njit(**_FAST)
def average_support(first, last, volume, guide, radius, contrast, out):
    """Mean cost over (2 radius + 1)^2 pixels, weighted by 1 / (1 + contrast |dI|^2)^2.

    ``guide`` (h, w, 3) is the colour image: pixels of another colour are likely to be of another
    surface, and their costs would fatten it. Four pixels are added at once, as most of the time of
    one would go into reading and writing the mean.
    """
    h, w, planes = volume.shape
    weights = np.empty((2 * radius + 1, 2 * radius + 1, w), np.float32)
    for y in range(first, last):
        top, bottom = max(y - radius, 0), min(y + radius + 1, h)
        for v in range(top, bottom):
            for i in range(2 * radius + 1):
                _likeness_of_row(guide, y, v, i - radius, contrast, weights[v - top, i])
        for x in range(w):
            mean = out[y, x]
            total = np.float32(0.0)
            for k in range(planes):
                mean[k] = np.float32(0.0)
            left, right = max(x - radius, 0), min(x + radius + 1, w)
            for v in range(top, bottom):
                j = v - top
                u = left
                while u < right:
                    i = u + radius - x
                    a = volume[v, u]
                    p = weights[j, i, x]
                    if u + 4 <= right:
                        b, c, d = volume[v, u + 1], volume[v, u + 2], volume[v, u + 3]
                        q, r = weights[j, i + 1, x], weights[j, i + 2, x]
                        s = weights[j, i + 3, x]
                        for k in range(planes):
                            mean[k] += p * a[k] + q * b[k] + r * c[k] + s * d[k]
                        total += p + q + r + s
                        u += 4
                    elif u + 2 <= right:
                        b = volume[v, u + 1]
                        q = weights[j, i + 1, x]
                        for k in range(planes):
                            mean[k] += p * a[k] + q * b[k]
                        total += p + q
                        u += 2
                    else:
                        for k in range(planes):
                            mean[k] += p * a[k]
                        total += p
                        u += 1
            norm = np.float32(1.0) / total
            for k in range(planes):
                mean[k] *= norm


@njit(**_FAST)
def pull_to_prior(first, last, volume, planes, prior, weight, tolerance):
    """Add weight min(|rho / prior - 1| / tolerance, 1) to the cost of each plane."""
    one = np.float32(1.0)
    for y in range(first, last):
        for x in range(volume.shape[1]):
            pull = weight[y, x]
            if pull > np.float32(0.0):
                cost = volume[y, x]
                inverse = one / prior[y, x]
                for k in range(planes.shape[0]):
                    cost[k] += pull * min(abs(planes[k] * inverse - one) / tolerance, one)


@njit(**_PART)
def _follow_path(cost, previous, small, large, current):
    """One step of Hirschmueller's Eq. 13 (without the constant): costs along one path.

    ``previous`` and ``current`` have a FAR sentinel at both ends of the planes.
    """
    planes = cost.shape[0]
    low = FAR
    for k in range(planes):
        low = min(low, previous[k + 1])
    top = low + large
    for k in range(planes):
        step = min(previous[k], previous[k + 2]) + small
        current[k + 1] = cost[k] + min(min(previous[k + 1], top), step) - low


@njit(**_FAST)
def aggregate_paths(volume, image, small, large, edge, forward, total):
    """Add the four path costs that a scan in one order can follow to ``total``.

    Forward: from the left, upper left, top and upper right; backward: the four opposite ones. A
    jump of more than one plane costs max(1.5 small, large / (1 + edge |dI|)).
    """
    h, w, planes = volume.shape
    s = 1 if forward else -1
    rows = np.full((2, 3, w, planes + 2), FAR, np.float32)
    side = np.full((2, planes + 2), FAR, np.float32)
    lowest = np.float32(1.5) * small
    for i in range(h):
        y = i if forward else h - 1 - i
        for j in range(w):
            x = j if forward else w - 1 - j
            cost = volume[y, x]
            out = total[y, x]
            for direction in range(4):
                dx = s * (direction - 1) if direction < 3 else s
                dy = s if direction < 3 else 0
                current = rows[i % 2, direction, x] if direction < 3 else side[j % 2]
                px, py = x - dx, y - dy
                if px < 0 or px >= w or py < 0 or py >= h:
                    for k in range(planes):
                        current[k + 1] = cost[k]
                else:
                    previous = rows[1 - i % 2, direction, px] if direction < 3 else side[1 - j % 2]
                    contrast = abs(image[y, x] - image[py, px])
                    jump = max(lowest, large / (np.float32(1.0) + edge * contrast))
                    _follow_path(cost, previous, small, jump, current)
                for k in range(planes):
                    out[k] += current[k + 1]


@njit(**_FAST)
def pick_planes(first, last, total, volume, position, cost, margin):
    """Winning plane with its parabola's vertex, its matching cost, and its margin to the others.

    ``margin`` is the smallest aggregated cost more than two planes away less the winner's.
    """
    _, w, planes = total.shape
    for y in range(first, last):
        for x in range(w):
            t = total[y, x]
            best = 0
            low = t[0]
            for k in range(1, planes):
                if t[k] < low:
                    best = k
                    low = t[k]
            second = FAR
            for k in range(0, best - 2):
                second = min(second, t[k])
            for k in range(best + 3, planes):
                second = min(second, t[k])
            shift = np.float32(0.0)
            if 0 < best < planes - 1:
                curvature = t[best - 1] + t[best + 1] - np.float32(2.0) * low
                if curvature > np.float32(1e-6):
                    shift = (t[best - 1] - t[best + 1]) / (np.float32(2.0) * curvature)
            position[y, x] = np.float32(best) + shift
            cost[y, x] = volume[y, x, best]
            margin[y, x] = second - low
