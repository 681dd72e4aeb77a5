"""Compiled window lookup on the CPU."""

import numpy as np
from numba import njit

SIDE = 7
_TAPS = 8


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def lookup_windows(source, target, centres, levels, scales, norm, out):
    """Fill ``out`` (cells, levels, 49) for one edge.

    ``source`` (cells, c), ``target`` (positions, c), ``centres`` (cells, 2) in pixels; ``levels``
    rows of offset, width, height; ``scales`` rows of factor and shift from pixels; all float32.
    """
    channels = source.shape[1]
    taps = np.empty((_TAPS, _TAPS), np.float32)
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
            for j in range(_TAPS):
                row = v - SIDE // 2 + j
                for i in range(_TAPS):
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
