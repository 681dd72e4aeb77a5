"""Compiled loop over pixels of a frame whose rows were rectified; it releases the interpreter lock.

It replaces some two hundred small PyTorch operations; edges have some thousands of pixels each.
"""

import numpy as np
from numba import njit

from geogs.geometry.bend_kernels import FAST, aside_at, growth_at

_NODES = 5
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@njit(**FAST)
def shift_pixels(
    field, times, motions, camera, more, limits, factor, pixels, plane, inverse_depth, shift, slope
):
    """Fill ``shift`` and ``slope`` (p, 2), see :meth:`RowErrors.of_pixels`.

    Of the frame: ``field`` (r, c, 3) of offsets and seconds, times (5) of the nodes and motions
    (5, 4, 4) to them. ``camera``: fx, fy, cx, cy, k1, k2, and ``more`` of it or None
    (:mod:`geogs.geometry.bend_kernels`); ``limits``: pixels of a cell of the field and the least z.
    Then the factor on the readout, pixels (p, 2), their points on the plane z = 1
    (p, 2) and inverse depths (p); all float32.
    """
    fx = camera[0]
    fy = camera[1]
    cx = camera[2]
    cy = camera[3]
    k1 = camera[4]
    k2 = camera[5]
    cell = limits[0]
    nearest = limits[1]
    bottom, right = field.shape[0] - 1, field.shape[1] - 1
    seconds = np.empty(len(pixels), np.float32)
    inverse_span = np.empty((_NODES, _NODES), np.float32)
    for j in range(_NODES):
        for other in range(_NODES):
            inverse_span[j, other] = _ONE / (times[j] - times[other]) if j != other else _ONE
    for n in range(len(pixels)):
        x = (pixels[n, 0] + cell + _HALF) / cell - _HALF
        y = (pixels[n, 1] + cell + _HALF) / cell - _HALF
        x, y = x if x > _ZERO else _ZERO, y if y > _ZERO else _ZERO
        x, y = min(x, np.float32(right)), min(y, np.float32(bottom))
        left, top = min(int(x), right - 1), min(int(y), bottom - 1)
        a, b = x - np.float32(left), y - np.float32(top)
        first, second = field[top], field[top + 1]
        for k in range(3):
            above = first[left, k] + a * (first[left + 1, k] - first[left, k])
            below = second[left, k] + a * (second[left + 1, k] - second[left, k])
            value = above + b * (below - above)
            if k < 2:
                shift[n, k] = value
            else:
                seconds[n] = value
    for n in range(len(pixels)):
        at = factor * seconds[n]
        d = inverse_depth[n]
        x, y = plane[n, 0], plane[n, 1]
        u = v = along = across = _ZERO
        for j in range(_NODES):
            weight = _ONE
            change = _ZERO
            for other in range(_NODES):
                if other != j:
                    part = (at - times[other]) * inverse_span[j, other]
                    change = change * part + weight * inverse_span[j, other]
                    weight *= part
            M = motions[j]
            z = M[2, 0] * x + M[2, 1] * y + M[2, 2] + M[2, 3] * d
            q = _ONE / (nearest if z < nearest else z)
            X = (M[0, 0] * x + M[0, 1] * y + M[0, 2] + M[0, 3] * d) * q
            Y = (M[1, 0] * x + M[1, 1] * y + M[1, 2] + M[1, 3] * d) * q
            u += weight * X
            v += weight * Y
            along += change * X
            across += change * Y
        square = u * u + v * v
        growth, bent, _, _, _ = growth_at(square, k1, k2, more)
        aside_x, aside_y, xx, xy, yy = aside_at(u, v, more)
        turned = bent * (u * along + v * across)
        bent_along = along * growth + u * turned + xx * along + xy * across
        bent_across = across * growth + v * turned + xy * along + yy * across
        shift[n, 0] += pixels[n, 0] - ((u * growth + aside_x) * fx + cx)
        shift[n, 1] += pixels[n, 1] - ((v * growth + aside_y) * fy + cy)
        slope[n, 0] = -seconds[n] * bent_along * fx
        slope[n, 1] = -seconds[n] * bent_across * fy
