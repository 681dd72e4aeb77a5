"""Compiled loops that look up points in the depth maps of other views."""

import numpy as np
from numba import njit

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


@njit(**_FAST)
def relative_depths(points, rotation, translation, lens, depth, confidence, ratio, sure):
    """z / depth at each point's pixel of a view, and that pixel's confidence.

    ``points`` (n, 3) float32 in any frame that (rotation, translation) takes to the view's camera;
    ``lens`` = (fx, fy, cx, cy). Points behind the camera, outside the image or on a pixel without
    depth get ratio 0 and confidence 0.
    """
    h, w = depth.shape
    for i in range(points.shape[0]):
        ratio[i] = np.float32(0.0)
        sure[i] = np.float32(0.0)
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if not cz > np.float32(1e-4):
            continue
        cx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        cy = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        u = np.floor(lens[0] * cx / cz + lens[2] + np.float32(0.5))
        v = np.floor(lens[1] * cy / cz + lens[3] + np.float32(0.5))
        if not (u >= 0 and v >= 0 and u < w and v < h):
            continue
        d = depth[int(v), int(u)]
        if d > np.float32(0.0):
            ratio[i] = cz / d
            sure[i] = confidence[int(v), int(u)]
