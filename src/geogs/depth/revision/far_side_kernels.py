"""Compiled loops of the farther surface beside a pixel.

Arrays are float32 and C-contiguous; every kernel releases the interpreter lock.
"""

import numpy as np
from numba import njit

from geogs.kernel_parts import inlined

_FAST = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
"""NaN must compare as NaN."""
_PART = inlined(_FAST)
ZERO = np.float32(0)


@njit(**_PART)
def extended(planes, v, u, dy, dx, farthest, most):
    """Inverse depth at (v, u) of the plane of pixel (v + dy, u + dx); 0 unless it is between
    ``farthest`` and ``most``. ``planes`` (3, h, w): inverse depth and its slopes."""
    y, x = v + dy, u + dx
    if y < 0 or x < 0 or y >= planes.shape[1] or x >= planes.shape[2] or planes[0, y, x] <= ZERO:
        return ZERO
    here = planes[0, y, x] - np.float32(dx) * planes[1, y, x] - np.float32(dy) * planes[2, y, x]
    return here if (here >= farthest) & (here < most) else ZERO


@njit(**_FAST)
def farther_planes(planes, farthest, ratio, reach, found):
    """Planes of farther surfaces within ``reach`` pixels, extended from pixel to pixel.

    A surface is farther if its inverse depth at a pixel is below ``ratio`` times the pixel's own.
    ``found`` (3, h, w), zero on entry, receives inverse depth and slopes. Each round extends only
    what the last one has found.
    """
    height, width = found.shape[1], found.shape[2]
    age = np.zeros((height, width), np.int32)
    for round in range(1, reach + 1):
        any_new = False
        for v in range(height):
            for u in range(width):
                if age[v, u] > 0:
                    continue
                most = ratio * planes[0, v, u]
                for step in range(9):
                    dy, dx = step // 3 - 1, step % 3 - 1
                    if step == 4:
                        continue
                    y, x = v + dy, u + dx
                    if round == 1:
                        here = extended(planes, v, u, dy, dx, farthest, most)
                        source = planes
                    else:
                        if y < 0 or x < 0 or y >= height or x >= width or age[y, x] != round - 1:
                            continue
                        here = extended(found, v, u, dy, dx, farthest, most)
                        source = found
                    if here > ZERO:
                        found[0, v, u] = here
                        found[1, v, u] = source[1, y, x]
                        found[2, v, u] = source[2, y, x]
                        age[v, u] = round
                        any_new = True
                        break
        if not any_new:
            break
