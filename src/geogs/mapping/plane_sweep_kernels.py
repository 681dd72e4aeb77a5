"""Compiled loops of the plane sweep: matching cost, semi-global aggregation, winner.

Images are (h, w); cost volumes are (h, w, planes), so that the innermost loops run over planes with
unit stride. All arrays are float32 and C-contiguous. Every kernel releases the interpreter lock.
"""

import numpy as np
from numba import njit

BLOCK = 16
"""Planes matched before their costs are transposed into the volume: one cache line of float32."""
FAR = np.float32(1e9)
OUTSIDE = np.float32(1.2)
"""Cost of a sample outside the neighbour, a little more than that of no likeness (1)."""

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


@njit(**_FAST)
def _warp_plane(image, a, b, rho, warped, lowest):
    """Sample ``image`` where the fronto-parallel plane of inverse depth ``rho`` projects.

    Homogeneous pixel q = a p + rho b. ``lowest``, the least cost a pixel may get, is OUTSIDE where
    the sample leaves the image and 0 elsewhere. The loop over x is split so that all but the
    gathering of samples vectorises.
    """
    h, w = image.shape
    flat = image.ravel()
    right, down = np.uint32(1), np.uint32(w)
    last_u, last_v = np.float32(w - 1.001), np.float32(h - 1.001)
    s0, s1, s2 = np.float32(a[0, 0]), np.float32(a[1, 0]), np.float32(a[2, 0])
    n = warped.shape[1]
    index = np.empty(n, np.uint32)
    fraction_u, fraction_v = np.empty(n, np.float32), np.empty(n, np.float32)
    for y in range(warped.shape[0]):
        c0 = np.float32(a[0, 1] * y + a[0, 2] + rho * b[0])
        c1 = np.float32(a[1, 1] * y + a[1, 2] + rho * b[1])
        c2 = np.float32(a[2, 1] * y + a[2, 2] + rho * b[2])
        low, out = lowest[y], warped[y]
        for x in range(n):
            column = np.float32(np.int32(x))
            q2 = c2 + s2 * column
            inverse = np.float32(1.0) / max(q2, np.float32(1e-3))
            u = (c0 + s0 * column) * inverse
            v = (c1 + s1 * column) * inverse
            cu = min(max(u, np.float32(0.0)), last_u)
            cv = min(max(v, np.float32(0.0)), last_v)
            gone = abs(cu - u) + abs(cv - v) + max(np.float32(1e-3) - q2, np.float32(0.0))
            low[x] = OUTSIDE if gone > np.float32(0.0) else np.float32(0.0)
            whole_u, whole_v = np.floor(cu), np.floor(cv)
            fraction_u[x] = cu - whole_u
            fraction_v[x] = cv - whole_v
            index[x] = np.uint32(np.int32(whole_v * np.float32(w) + whole_u))
        for x in range(n):
            k = index[x]
            top = flat[k] + fraction_u[x] * (flat[k + right] - flat[k])
            k += down
            bottom = flat[k] + fraction_u[x] * (flat[k + right] - flat[k])
            out[x] = top + fraction_v[x] * (bottom - top)


@njit(**_FAST)
def _window_sums(column, radius, out):
    """Horizontal window sums of the column sums; ``column`` carries ``radius`` repeats a side."""
    w = out.shape[0]
    for i in range(radius):
        column[i] = column[radius]
        column[radius + w + i] = column[radius + w - 1]
    for x in range(w):
        out[x] = column[x] + column[x + 1] + column[x + 2]
    for i in range(3, 2 * radius + 1):
        for x in range(w):
            out[x] += column[x + i]


@njit(**_FAST)
def _add_row(reference, warped, sign, radius, ones, squares, products):
    """Add (sign 1) or take away (sign -1) one image row from the running column sums."""
    for x in range(warped.shape[0]):
        s = warped[x]
        ones[radius + x] += sign * s
        squares[radius + x] += sign * s * s
        products[radius + x] += sign * s * reference[x]


@njit(**_FAST)
def _ncc_cost(reference, mean, scale, warped, lowest, radius, floor, out):
    """out = 1 - NCC over (2 radius + 1)^2 windows, softened where variances are near ``floor``.

    ``scale`` is 1 / sqrt(variance + floor) of the reference windows. Running column sums: the
    images should be centred about zero so that little is lost to cancellation.
    """
    h, w = reference.shape
    norm = np.float32(1.0 / (2 * radius + 1) ** 2)
    one = np.float32(1.0)
    ones = np.zeros(w + 2 * radius, np.float32)
    squares, products = np.zeros_like(ones), np.zeros_like(ones)
    sum_b = np.empty(w, np.float32)
    sum_bb, sum_ab = np.empty_like(sum_b), np.empty_like(sum_b)
    for dy in range(-radius, radius):
        y = min(max(dy, 0), h - 1)
        _add_row(reference[y], warped[y], one, radius, ones, squares, products)
    for y in range(h):
        y1 = min(y + radius, h - 1)
        _add_row(reference[y1], warped[y1], one, radius, ones, squares, products)
        _window_sums(ones, radius, sum_b)
        _window_sums(squares, radius, sum_bb)
        _window_sums(products, radius, sum_ab)
        ma, sa, low, row = mean[y], scale[y], lowest[y], out[y]
        for x in range(w):
            m = sum_b[x] * norm
            spread = max(sum_bb[x] * norm - m * m, np.float32(0.0)) + floor
            cost = one - (sum_ab[x] * norm - ma[x] * m) * sa[x] / np.sqrt(spread)
            row[x] = max(min(cost, OUTSIDE), low[x])
        y0 = max(y - radius, 0)
        _add_row(reference[y0], warped[y0], -one, radius, ones, squares, products)


@njit(**_FAST)
def _keep_best(cost, best):
    """Insert ``cost`` into the sorted smallest costs ``best`` (keep, h, w)."""
    keep = best.shape[0]
    for y in range(cost.shape[0]):
        for x in range(cost.shape[1]):
            c = cost[y, x]
            for k in range(keep):
                b = best[k, y, x]
                best[k, y, x] = min(b, c)
                c = max(b, c)


@njit(**_FAST)
def match_planes(reference, mean, scale, images, a, b, planes, radius, floor, keep, volume):
    """volume[y, x, k] = mean of the ``keep`` smallest 1 - NCC over the neighbours, at plane k.

    ``a`` (n, 3, 3), ``b`` (n, 3): homographies a + rho b e_3^T of the neighbours (float64).
    """
    h, w = reference.shape
    n = images.shape[0]
    warped, lowest = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    cost = np.empty((h, w), np.float32)
    best = np.empty((keep, h, w), np.float32)
    block = np.empty((h, BLOCK, w), np.float32)
    share = np.float32(1.0 / keep)
    for start in range(0, planes.shape[0], BLOCK):
        count = min(BLOCK, planes.shape[0] - start)
        for k in range(count):
            best[:] = FAR
            for j in range(n):
                _warp_plane(images[j], a[j], b[j], planes[start + k], warped, lowest)
                _ncc_cost(reference, mean, scale, warped, lowest, radius, floor, cost)
                _keep_best(cost, best)
            for y in range(h):
                for x in range(w):
                    block[y, k, x] = best[0, y, x] * share
                for i in range(1, keep):
                    for x in range(w):
                        block[y, k, x] += best[i, y, x] * share
        for y in range(h):
            for x in range(w):
                for k in range(count):
                    volume[y, x, start + k] = block[y, k, x]


@njit(**_FAST)
def average_support(volume, guide, radius, contrast, out):
    """Mean cost over (2 radius + 1)^2 pixels, weighted by 1 / (1 + contrast |dI|^2)^2.

    ``guide`` (h, w, 3) is the colour image: pixels of another colour are likely to be of another
    surface, and their costs would fatten it.
    """
    h, w, planes = volume.shape
    one = np.float32(1.0)
    for y in range(h):
        for x in range(w):
            mean = out[y, x]
            for k in range(planes):
                mean[k] = np.float32(0.0)
            total = np.float32(0.0)
            for v in range(max(y - radius, 0), min(y + radius + 1, h)):
                for u in range(max(x - radius, 0), min(x + radius + 1, w)):
                    red = guide[y, x, 0] - guide[v, u, 0]
                    green = guide[y, x, 1] - guide[v, u, 1]
                    blue = guide[y, x, 2] - guide[v, u, 2]
                    like = one + contrast * (red * red + green * green + blue * blue)
                    weight = one / (like * like)
                    total += weight
                    cost = volume[v, u]
                    for k in range(planes):
                        mean[k] += weight * cost[k]
            norm = one / total
            for k in range(planes):
                mean[k] *= norm


@njit(**_FAST)
def pull_to_prior(volume, planes, prior, weight, tolerance):
    """Add weight min(|rho / prior - 1| / tolerance, 1) to the cost of each plane."""
    one = np.float32(1.0)
    for y in range(volume.shape[0]):
        for x in range(volume.shape[1]):
            pull = weight[y, x]
            if pull > np.float32(0.0):
                cost, inverse = volume[y, x], one / prior[y, x]
                for k in range(planes.shape[0]):
                    cost[k] += pull * min(abs(planes[k] * inverse - one) / tolerance, one)


@njit(**_FAST)
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
            cost, out = volume[y, x], total[y, x]
            for direction in range(4):
                dx = s * (direction - 1) if direction < 3 else s
                dy = s if direction < 3 else 0
                if direction < 3:
                    current = rows[i % 2, direction, x]
                else:
                    current = side[j % 2]
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
def pick_planes(total, volume, position, cost, margin):
    """Winning plane with its parabola's vertex, its matching cost, and how far the others are.

    ``margin`` is the smallest aggregated cost more than two planes away less the winner's.
    """
    h, w, planes = total.shape
    for y in range(h):
        for x in range(w):
            t = total[y, x]
            best, low = 0, t[0]
            for k in range(1, planes):
                if t[k] < low:
                    best, low = k, t[k]
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
