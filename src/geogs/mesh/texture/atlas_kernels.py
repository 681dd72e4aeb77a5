"""The inner loop of drawing corrections into an atlas, in numba."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def draw_triangles(corners, values, drawn, covered):
    """Interpolate the values at the corners (t, 3, 2) of triangles over the pixels inside.

    ``values`` (t, 3, 3) go to ``drawn`` (h, w, 3), and ``covered`` (h, w) becomes 1 there. A pixel
    within half a pixel of a triangle counts as inside, so that no gaps are left between them.
    """
    height, width = covered.shape
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        left = max(0, math.floor(min(a[0], b[0], c[0])))
        right = min(width - 1, math.ceil(max(a[0], b[0], c[0])))
        top = max(0, math.floor(min(a[1], b[1], c[1])))
        bottom = min(height - 1, math.ceil(max(a[1], b[1], c[1])))
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-9:
            continue
        ab = math.hypot(b[0] - a[0], b[1] - a[1])
        bc = math.hypot(c[0] - b[0], c[1] - b[1])
        ca = math.hypot(a[0] - c[0], a[1] - c[1])
        slack_a, slack_b, slack_c = 0.5 * bc / abs(area), 0.5 * ca / abs(area), 0.5 * ab / abs(area)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                wa = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                wb = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                wc = 1.0 - wa - wb
                if wa >= -slack_a and wb >= -slack_b and wc >= -slack_c:
                    for k in range(3):
                        value = wa * values[t, 0, k] + wb * values[t, 1, k] + wc * values[t, 2, k]
                        drawn[y, x, k] = np.float32(value)
                    covered[y, x] = 1.0
