"""Compiled loops of the flow operators on the CPU; they release the interpreter lock."""

import numpy as np
from numba import njit

SIDE = 7
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
_THREE, _FOUR, _FIVE = np.float32(3.0), np.float32(4.0), np.float32(5.0)
_ZERO, _WHITE = np.float32(0.0), np.float32(255.0)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def lookup_windows(source, target, centres, levels, scales, norm, out):
    """Fill ``out`` (cells, levels, 49) for one edge.

    ``source`` (cells, c), ``target`` (positions, c), ``centres`` (cells, 2) in pixels; ``levels``
    rows of offset, width, height; ``scales`` rows of factor and shift from pixels; all float32.
    """
    channels = source.shape[1]
    taps = np.empty((SIDE + 1, SIDE + 1), np.float32)
    for cell in range(source.shape[0]):
        mine = source[cell]
        for level in range(levels.shape[0]):
            offset, width, height = levels[level]
            x = centres[cell, 0] * scales[level, 0] + scales[level, 1]
            y = centres[cell, 1] * scales[level, 0] + scales[level, 1]
            if not (-100.0 < x < 10000.0):
                x = np.float32(-100.0)
            if not (-100.0 < y < 10000.0):
                y = np.float32(-100.0)
            u, v = int(np.floor(x)), int(np.floor(y))
            a, b = x - np.float32(u), y - np.float32(v)
            for j in range(SIDE + 1):
                row = v - SIDE // 2 + j
                for i in range(SIDE + 1):
                    column = u - SIDE // 2 + i
                    total = np.float32(0.0)
                    if 0 <= row < height and 0 <= column < width:
                        theirs = target[offset + row * width + column]
                        for c in range(channels):
                            total += mine[c] * theirs[c]
                    taps[j, i] = total
            for j in range(SIDE):
                for i in range(SIDE):
                    top = taps[j, i] + a * (taps[j, i + 1] - taps[j, i])
                    bottom = taps[j + 1, i] + a * (taps[j + 1, i + 1] - taps[j + 1, i])
                    out[cell, level, j * SIDE + i] = norm * (top + b * (bottom - top))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})
def warp(image, x, y, warped):
    """Fill ``warped`` (uint8, of the shape of ``x``) with ``image`` (uint8, h w) interpolated at
    columns ``x`` and rows ``y`` (float32); the border is replicated.

    By cubic convolution (Keys 1981, a = -1/2), which preserves a slope. OpenCV's (a = -3/4) does
    not: it shifts image content by up to 0.04 pixels, and flow follows.
    """
    bottom, right = image.shape[0] - 1, image.shape[1] - 1
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            u, v = x[row, column], y[row, column]
            u, v = u if u > -_TWO else -_TWO, v if v > -_TWO else -_TWO  # NaN, too
            u, v = min(u, np.float32(right + 2)), min(v, np.float32(bottom + 2))
            left, top = np.floor(u), np.floor(v)
            t = u - left
            a = _HALF * t * (t * (_TWO - t) - _ONE)
            b = _HALF * (t * t * (_THREE * t - _FIVE) + _TWO)
            c = _HALF * t * (t * (_FOUR - _THREE * t) + _ONE)
            d = _HALF * t * t * (t - _ONE)
            t = v - top
            above = _HALF * t * (t * (_TWO - t) - _ONE)
            upper = _HALF * (t * t * (_THREE * t - _FIVE) + _TWO)
            lower = _HALF * t * (t * (_FOUR - _THREE * t) + _ONE)
            below = _HALF * t * t * (t - _ONE)
            i, j = int(left) - 1, int(top) - 1
            k = i + 1
            m = i + 2
            n = i + 3
            p, q, r = j + 1, j + 2, j + 3
            if i < 0 or j < 0 or n > right or r > bottom:
                i, k = min(max(i, 0), right), min(max(k, 0), right)
                m, n = min(max(m, 0), right), min(max(n, 0), right)
                j = min(max(j, 0), bottom)
                p = min(max(p, 0), bottom)
                q, r = min(max(q, 0), bottom), min(max(r, 0), bottom)
            value = (
                above * (a * image[j, i] + b * image[j, k] + c * image[j, m] + d * image[j, n])
                + upper * (a * image[p, i] + b * image[p, k] + c * image[p, m] + d * image[p, n])
                + lower * (a * image[q, i] + b * image[q, k] + c * image[q, m] + d * image[q, n])
                + below * (a * image[r, i] + b * image[r, k] + c * image[r, m] + d * image[r, n])
            )
            warped[row, column] = np.uint8(min(max(value + _HALF, _ZERO), _WHITE))
