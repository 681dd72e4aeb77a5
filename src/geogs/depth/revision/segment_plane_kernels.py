"""Compiled loops of the planes of bare segments: the rim of a segment, and the planes through it.

Images are (h, w) and C-contiguous; a box is its first row and column, and those behind its last;
positions are x and y as fractions of the image's width and height, from its middle. Every kernel
releases the interpreter lock. Numba compiles loops faster than expressions of arrays.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from geogs.kernel_parts import inlined

_EXACT = {"cache": True, "nogil": True, "error_model": "numpy"}
_FAST_PART = inlined({**_EXACT, "fastmath": {"contract", "nsz", "reassoc"}})
_PART = inlined(_EXACT)
"""Options of functions that call one with ``fastmath``."""


class PlaneRules(NamedTuple):
    """Limits of the search for planes."""

    reach: int
    """Pixels around a segment, or a part of it, that are its rim."""
    tolerance: float = 0.02
    """Relative distance in inverse depth from a plane within which a pixel lies on it."""
    min_explained: float = 0.35
    """Least fraction of the confident pixels, by confidence, that each plane explains."""
    min_on_plane: float = 0.6
    """Least fraction of the confident pixels at the rim of an uncertain part that lie on planes."""
    correlated: int = 25
    """Neighbouring pixels whose errors count as one for the deviation."""
    min_pixels: int = 40
    """Least pixels of a fit."""
    max_pixels: int = 750
    """Most pixels of a fit."""
    refits: int = 4
    """Fits of the inliers."""


@njit(**_EXACT)
def segment_boxes(labels, uncertain, sky, boxes, counts):
    """Boxes (n, 4) of the segments from 1 on, and counts (n, 3) of all their pixels, of those that
    are ``uncertain`` and of those of the ``sky``."""
    height, width = labels.shape
    boxes[:, 0] = height
    boxes[:, 1] = width
    boxes[:, 2:] = 0
    counts[:] = 0
    for v in range(height):
        for u in range(width):
            if labels[v, u] > 0:
                box = boxes[labels[v, u] - 1]
                count = counts[labels[v, u] - 1]
                box[0], box[1] = min(box[0], v), min(box[1], u)
                box[2], box[3] = max(box[2], v + 1), max(box[3], u + 1)
                count[0] += 1
                count[1] += uncertain[v, u]
                count[2] += sky[v, u]


@njit(**_EXACT)
def widened(box, reach, shape):
    """A box widened by ``reach`` on all sides, within an image."""
    return (
        max(0, box[0] - reach),
        max(0, box[1] - reach),
        min(shape[0], box[2] + reach),
        min(shape[1], box[3] + reach),
    )


@njit(**_EXACT)
def near_part(parts, number, box, reach):
    """Mask, of the size of a box, of the pixels at most ``reach`` rows and columns from a part that
    lies in the box."""
    top, left, low, right = box
    height, width = low - top, right - left
    across = np.empty((height, width), np.uint8)
    near = np.empty((height, width), np.uint8)
    for v in range(height):
        since = reach + 1
        for u in range(width):
            since = 0 if parts[top + v, left + u] == number else since + 1
            across[v, u] = since <= reach
        since = reach + 1
        for u in range(width - 1, -1, -1):
            since = 0 if parts[top + v, left + u] == number else since + 1
            across[v, u] |= since <= reach
    for u in range(width):  # numba takes seconds to compile assignments of whole rows
        count = 0
        for v in range(-reach, height):
            count += across[v + reach, u] if v + reach < height else 0
            count -= across[v - reach - 1, u] if v > reach else 0
            if v >= 0:
                near[v, u] = count > 0
    return near


@njit(**_EXACT)
def rim_pixels(labels, label, box, reach, confident):
    """Flat indices of the ``confident`` pixels within ``reach`` of a segment, row by row."""
    whole = box[0], box[1], box[2], box[3]
    top, left, low, right = wide = widened(whole, reach, labels.shape)
    near = near_part(labels, label, wide, reach)
    pixels = np.empty(near.size, np.int64)
    count = 0
    for v in range(top, low):
        for u in range(left, right):
            pixels[count] = v * labels.shape[1] + u
            count += near[v - top, u - left] & confident[v, u]
    return pixels[:count].copy()


@njit(**_EXACT)
def at_pixel(plane, v, u, shape):
    """Inverse depth of a plane at a pixel, and the pixel's position (x, y)."""
    x, y = (u + 0.5) / shape[1] - 0.5, (v + 0.5) / shape[0] - 0.5
    return plane[0] * x + plane[1] * y + plane[2], x, y


@njit(**_EXACT)
def connected(labels, label, uncertain, v0, u0, parts, number, pixels):
    """Write a ``number`` into ``parts`` at the 8-connected ``uncertain`` pixels of a segment around
    one of them, and their flat indices into ``pixels``; returns their box and how many they are."""
    height, width = labels.shape
    parts[v0, u0] = number
    pixels[0] = v0 * width + u0
    done = 0
    found = 1
    top = v0
    left = u0
    low = v0
    right = u0
    while done < found:
        v, u = pixels[done] // width, pixels[done] % width
        done += 1
        top = min(top, v)
        left = min(left, u)
        low = max(low, v)
        right = max(right, u)
        for y in range(max(v - 1, 0), min(v + 2, height)):
            for x in range(max(u - 1, 0), min(u + 2, width)):
                if parts[y, x] == 0 and labels[y, x] == label and uncertain[y, x]:
                    parts[y, x] = number
                    pixels[found] = y * width + x
                    found += 1
    return (top, left, low + 1, right + 1), found


@njit(**_EXACT)
def mark_supported(labels, label, box, uncertain, confident, depth, planes, rules, parts, marked):
    """Write a segment's label into ``marked`` at its connected uncertain parts, of at least
    ``min_pixels``, at whose own rim a fraction ``min_on_plane`` of the confident pixels lies on one
    of its planes.

    ``parts``, which is 0 in the segment on entry, receives a number of its own for each part.
    """
    pixels = np.empty((box[2] - box[0]) * (box[3] - box[1]), np.int32)
    shape = labels.shape
    for v0 in range(box[0], box[2]):
        for u0 in range(box[1], box[3]):
            if parts[v0, u0] != 0 or labels[v0, u0] != label or not uncertain[v0, u0]:
                continue
            number = 1 + v0 * shape[1] + u0
            own, count = connected(labels, label, uncertain, v0, u0, parts, number, pixels)
            if count < rules.min_pixels:
                continue
            wide = widened(own, rules.reach, shape)
            near = near_part(parts, number, wide, rules.reach)
            around = 0
            on = 0
            for v in range(wide[0], wide[2]):
                for u in range(wide[1], wide[3]):
                    if near[v - wide[0], u - wide[1]] and confident[v, u]:
                        around += 1
                        value = 1 / np.float64(depth[v, u])
                        is_on = False
                        for p in range(len(planes)):
                            off = abs(at_pixel(planes[p], v, u, shape)[0] - value)
                            is_on |= off < rules.tolerance * value
                        on += is_on
            if on >= rules.min_on_plane * max(1, around):
                for k in range(count):
                    marked[pixels[k] // shape[1], pixels[k] % shape[1]] = label


@njit(**_EXACT)
def planes_of_segment(
    labels, label, box, uncertain, confident, depth, confidence, draws, rules, parts, marked
):
    """Planes (p, 3) of a segment, their covariances, and how many were tried; also flat indices of
    some confident pixels at the segment and its rim, and the number, from 1 on, of their planes.

    ``marked`` and ``parts`` are as in ``mark_supported``.
    """
    known = rim_pixels(labels, label, box, rules.reach, confident)
    some = known[:: max(1, -(-len(known) // rules.max_pixels))]
    x = np.empty(len(some))
    y = np.empty(len(some))
    value = np.empty(len(some))
    weight = np.empty(len(some))
    for i in range(len(some)):
        v, u = some[i] // labels.shape[1], some[i] % labels.shape[1]
        x[i] = (u + 0.5) / labels.shape[1] - 0.5
        y[i] = (v + 0.5) / labels.shape[0] - 0.5
        value[i] = 1 / np.float64(depth[v, u])
        weight[i] = confidence[v, u]
    planes, covariances, of, tried = segment_planes(x, y, value, weight, draws, rules)
    if len(planes):
        mark_supported(
            labels, label, box, uncertain, confident, depth, planes, rules, parts, marked
        )
    return planes, covariances, tried, some, of


@njit(**_EXACT)
def mark_stable(marked, label, nearest, box, planes, covariances, most, first, which):
    """Write into ``which`` the numbers, from ``first`` on, of the planes ``nearest`` to a segment's
    ``marked`` pixels, where their relative deviation is below ``most``."""
    for v in range(box[0], box[2]):
        for u in range(box[1], box[3]):
            if marked[v, u] == label:
                number = nearest[v, u]
                own, x, y = at_pixel(planes[number], v, u, marked.shape)
                c = covariances[number]
                mixed = c[0, 1] * x * y + c[0, 2] * x + c[1, 2] * y
                variance = c[0, 0] * x * x + c[1, 1] * y * y + c[2, 2] + 2 * mixed
                if np.sqrt(variance) < most * max(own, 1e-9):
                    which[v, u] = first + number


@njit(**_EXACT)
def planar_pixels(which, planes, depth, confidence, uncertain, farthest, pixels, found):
    """Flat indices, and z on their planes, of pixels whose confidence is at most ``uncertain`` and
    whose plane is not ``farthest`` times nearer or farther than their depth; returns how many."""
    count = 0
    shape = which.shape
    for v in range(shape[0]):
        for u in range(shape[1]):
            if which[v, u] == 0 or not confidence[v, u] <= uncertain:
                continue
            value = at_pixel(planes[which[v, u] - 1], v, u, shape)[0]
            own = 1 / depth[v, u]
            if value > own / farthest and value < farthest * own:
                pixels[count] = v * shape[1] + u
                found[count] = 1 / value
                count += 1
    return count


@njit(**_EXACT)
def solved(sums, damping, x, y, z):
    """Solution of the damped symmetric 3 x 3 system, six numbers of the matrix, for x, y and z."""
    a, b, c, d, e, f = sums
    a = a + damping
    d = d + damping
    f = f + damping
    A = d * f - e * e
    B = c * e - b * f
    C = b * e - c * d
    D = a * f - c * c
    E = b * c - a * e
    F = a * d - b * b
    inverse = 1 / (a * A + b * B + c * C)
    return (
        (A * x + B * y + C * z) * inverse,
        (B * x + D * y + E * z) * inverse,
        (C * x + E * y + F * z) * inverse,
    )


@njit(**_FAST_PART)
def explained(x, y, value, weight, tolerance, a, b, c):
    """Weight of the pixels on the plane a x + b y + c."""
    total = 0.0
    for i in range(len(value)):
        off = abs(a * x[i] + b * y[i] + c - value[i])
        total += weight[i] if off < tolerance * value[i] else 0.0
    return total


@njit(**_PART)
def summed(weight):
    """Sum in order, from the first on."""
    total = 0.0
    for i in range(len(weight)):
        total += weight[i]
    return total


@njit(**_PART)
def drawn(chance, uniform):
    """Index of the first of the increasing chances that is greater than a random number."""
    low, high = 0, len(chance)
    while low < high:
        middle = (low + high) // 2
        if chance[middle] <= uniform:
            low = middle + 1
        else:
            high = middle
    return low


@njit(**_PART)
def best_sample(x, y, value, weight, uniform, tolerance):
    """The plane through three pixels that explains most of the weight, and that weight; it is
    negative if there is none.

    ``uniform`` (t, 3) draws the pixels in proportion to their weight.
    """
    whole = summed(weight)
    reached = 0.0
    chance = np.empty(len(weight))
    for n in range(len(weight)):
        reached += weight[n] / whole
        chance[n] = reached
    for n in range(len(weight)):
        chance[n] /= reached
    best = (0.0, 0.0, 0.0)
    most = -1.0
    for t in range(len(uniform)):
        i = drawn(chance, uniform[t, 0])
        j = drawn(chance, uniform[t, 1])
        k = drawn(chance, uniform[t, 2])
        x1 = x[j] - x[i]
        y1 = y[j] - y[i]
        v1 = value[j] - value[i]
        x2 = x[k] - x[i]
        y2 = y[k] - y[i]
        v2 = value[k] - value[i]
        area = x1 * y2 - x2 * y1
        if abs(area) <= 1e-9:
            continue
        a, b = (v1 * y2 - v2 * y1) / area, (x1 * v2 - x2 * v1) / area
        c = value[i] - a * x[i] - b * y[i]
        on = explained(x, y, value, weight, tolerance, a, b, c)
        if on > most:
            best = (a, b, c)
            most = on
    return best, most


@njit(**_PART)
def mark_inliers(x, y, value, tolerance, a, b, c, on):
    """Write which pixels are ``on`` the plane a x + b y + c; return their number."""
    count = 0
    for i in range(len(value)):
        on[i] = abs(a * x[i] + b * y[i] + c - value[i]) < tolerance * value[i]
        count += on[i]
    return count


@njit(**_PART)
def fit_plane(x, y, value, weight, uniform, rules):
    """Fit a plane by random samples of three pixels, then by least squares to its inliers; return
    it, the inliers, and their weighted sums of xx, xy, x, yy, y and 1. Too few count as none.
    """
    (a, b, c), most = best_sample(x, y, value, weight, uniform, rules.tolerance)
    on = np.empty(len(value), np.bool_)
    sums = np.zeros(6)
    count = mark_inliers(x, y, value, rules.tolerance, a, b, c, on)
    for _ in range(rules.refits):
        if most < 0 or count < rules.min_pixels:
            on[:] = False
            break
        sums[:] = 0.0
        xv = 0.0
        yv = 0.0
        v = 0.0
        for i in range(len(value)):
            if on[i]:
                wx = weight[i] * x[i]
                wy = weight[i] * y[i]
                w = weight[i]
                sums[0], sums[1], sums[2] = sums[0] + wx * x[i], sums[1] + wx * y[i], sums[2] + wx
                sums[3], sums[4], sums[5] = sums[3] + wy * y[i], sums[4] + wy, sums[5] + w
                xv = xv + wx * value[i]
                yv = yv + wy * value[i]
                v = v + w * value[i]
        a, b, c = solved(sums, 1e-12, xv, yv, v)
        count = mark_inliers(x, y, value, rules.tolerance, a, b, c, on)
    return (a, b, c), on, sums


@njit(**_PART)
def segment_planes(x, y, value, weight, draws, rules):
    """Planes of a segment's pixels, the one of most weight first: coefficients of x, y and 1 (p, 3)
    and their covariances, the number, from 1 on, of each pixel's plane, and how many were tried.

    ``draws`` (n, t, 3) are the random numbers of at most n planes. Inliers are assumed to deviate
    by half the tolerance, and one in ``correlated`` of them to be independent.
    """
    planes = np.empty((len(draws), 3))
    covariances = np.empty((len(draws), 3, 3))
    of = np.zeros(len(x), np.int32)
    left = np.arange(len(x))
    found = 0
    tried = 0
    whole = summed(weight)
    while tried < len(draws) and len(left) >= rules.min_pixels:
        plane, on, sums = fit_plane(
            x[left], y[left], value[left], weight[left], draws[tried], rules
        )
        tried += 1
        count = 0
        own = 0.0
        values = 0.0
        for i in range(len(left)):
            if on[i]:
                own += weight[left[i]]
                values += value[left[i]]
                count += 1
        if count == 0 or own < rules.min_explained * whole:
            break
        variance = rules.correlated * (rules.tolerance / 2 * (values / count)) ** 2
        planes[found, 0], planes[found, 1], planes[found, 2] = plane
        for k in range(3):
            x1 = variance * (k == 0)
            y1 = variance * (k == 1)
            one = variance * (k == 2)
            row = solved(sums, 1e-9, x1, y1, one)
            covariances[found, k, 0], covariances[found, k, 1], covariances[found, k, 2] = row
        found += 1
        kept = 0
        for i in range(len(left)):
            if on[i]:
                of[left[i]] = found
            else:
                left[kept] = left[i]
                kept += 1
        left = left[:kept]
    return planes[:found], covariances[:found], of, tried
