"""The loops of colouring: what a view gives vertices, and corrections in an atlas; in numba."""

import math

import numpy as np
from numba import njit

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)


@njit(cache=True, nogil=True, error_model="numpy")
def add_colours(
    first, last, vertices, normals, T, lens, depth, image, tolerance, slack, least, total, weight
):
    """Add a view's weighted colours of the vertices ``first`` to ``last`` to ``total`` (n, 3), and
    their weights to ``weight`` (n).

    It sees those whose z lies within ``tolerance`` + ``slack`` z of its ``depth`` (h, w; infinite
    where unknown) and whose normal has a cosine of more than ``least`` to the ray. ``T``
    (3, 4) world to camera; ``lens`` fx, fy, cx, cy of the depth; ``image`` (ih, iw, 3) bytes.
    """
    height, width = depth.shape
    image_height = image.shape[0]
    image_width = image.shape[1]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    zoom_x = np.float32(image_width) / np.float32(width)
    zoom_y = np.float32(image_height) / np.float32(height)
    last_x, last_y = np.float32(image_width - 1), np.float32(image_height - 1)
    for i in range(first, last):
        a, b, c = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not z > ZERO:
            continue
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        u, v = fx * x / z + cx, fy * y / z + cy
        column, row = np.rint(u), np.rint(v)
        if not (column >= 0 and row >= 0 and column < width and row < height):
            continue
        if not abs(depth[np.int64(row), np.int64(column)] - z) < tolerance + slack * z:
            continue
        a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
        towards = x * (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c)
        towards += y * (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c)
        towards += z * (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c)
        cosine = -towards / np.sqrt(x * x + y * y + z * z)
        if not cosine > least:
            continue
        gain = (cosine / z) ** 2
        s = min(max((u + HALF) * zoom_x - HALF, ZERO), last_x)
        t = min(max((v + HALF) * zoom_y - HALF, ZERO), last_y)
        left, top = np.int64(s), np.int64(t)
        right, bottom = min(left + 1, image_width - 1), min(top + 1, image_height - 1)
        s, t = s - np.float32(left), t - np.float32(top)
        weight[i] += gain
        for k in range(3):
            p, q = np.float32(image[top, left, k]), np.float32(image[top, right, k])
            upper = p + s * (q - p)
            p, q = np.float32(image[bottom, left, k]), np.float32(image[bottom, right, k])
            total[i, k] += gain * (upper + t * (p + s * (q - p) - upper))


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
