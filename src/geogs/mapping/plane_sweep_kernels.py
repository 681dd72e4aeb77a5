"""Compiled loops of the plane sweep: matching cost, semi-global aggregation, winner.

Layout: images (h, w), cost volumes (h, w, planes) so that the innermost loops run over planes with
unit stride. All arrays are float32 and C-contiguous. Every kernel releases the interpreter lock.
"""

import numpy as np
from numba import njit

BLOCK = 16
"""Planes matched before their costs are transposed into the volume: one cache line of float32."""
FAR = np.float32(1e9)

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


@njit(**_FAST)
def _warp_plane(image, a, b, rho, warped, outside):
    """Sample ``image`` where the fronto-parallel plane of inverse depth ``rho`` projects.

    Homogeneous pixel q = a p + rho b. ``outside`` is 1 where the sample leaves the image.
    """
    h, w = image.shape
    flat = image.ravel()
    last_u, last_v = np.float32(w - 1.001), np.float32(h - 1.001)
    for y in range(warped.shape[0]):
        c0 = np.float32(a[0, 1] * y + a[0, 2] + rho * b[0])
        c1 = np.float32(a[1, 1] * y + a[1, 2] + rho * b[1])
        c2 = np.float32(a[2, 1] * y + a[2, 2] + rho * b[2])
        s0, s1, s2 = np.float32(a[0, 0]), np.float32(a[1, 0]), np.float32(a[2, 0])
        for x in range(warped.shape[1]):
            fx = np.float32(x)
            q2 = c2 + s2 * fx
            inverse = np.float32(1.0) / max(q2, np.float32(1e-3))
            u = (c0 + s0 * fx) * inverse
            v = (c1 + s1 * fx) * inverse
            cu = min(max(u, np.float32(0.0)), last_u)
            cv = min(max(v, np.float32(0.0)), last_v)
            gone = (cu != u) | (cv != v) | (q2 < np.float32(1e-3))
            outside[y, x] = np.float32(1.0) if gone else np.float32(0.0)
            iu = np.int32(cu)
            iv = np.int32(cv)
            ru = cu - np.float32(iu)
            rv = cv - np.float32(iv)
            k = np.uint32(iv * np.int32(w) + iu)
            top = flat[k] + ru * (flat[k + np.uint32(1)] - flat[k])
            k += np.uint32(w)
            bottom = flat[k] + ru * (flat[k + np.uint32(1)] - flat[k])
            warped[y, x] = top + rv * (bottom - top)


@njit(**_FAST)
def _row_sums(values, y, radius, column, out):
    """Sums of ``values`` over the (2 radius + 1)^2 windows of row ``y``; borders repeat."""
    h, w = values.shape
    for x in range(w):
        column[radius + x] = np.float32(0.0)
    for dy in range(-radius, radius + 1):
        yy = min(max(y + dy, 0), h - 1)
        for x in range(w):
            column[radius + x] += values[yy, x]
    for i in range(radius):
        column[i] = column[radius]
        column[radius + w + i] = column[radius + w - 1]
    for x in range(w):
        out[x] = column[x]
    for i in range(1, 2 * radius + 1):
        for x in range(w):
            out[x] += column[x + i]
