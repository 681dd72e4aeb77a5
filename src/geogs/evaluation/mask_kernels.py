"""Points against masks, in numba."""

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def keep_inside(points, T_cw, fx, fy, cx, cy, mask, kept):
    """Clear ``kept`` where a point falls on an unset pixel; outside the image it stays."""
    height, width = mask.shape
    for i in range(len(points)):
        if not kept[i]:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = T_cw[2, 0] * x + T_cw[2, 1] * y + T_cw[2, 2] * z + T_cw[2, 3]
        if depth <= 0.0:
            continue
        u = fx * (T_cw[0, 0] * x + T_cw[0, 1] * y + T_cw[0, 2] * z + T_cw[0, 3]) / depth + cx
        v = fy * (T_cw[1, 0] * x + T_cw[1, 1] * y + T_cw[1, 2] * z + T_cw[1, 3]) / depth + cy
        if not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        column, row = math.floor(u + 0.5), math.floor(v + 0.5)
        kept[i] = mask[row, column]
