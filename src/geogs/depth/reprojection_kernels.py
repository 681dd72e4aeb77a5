"""Compiled loops that look up points in the depth maps of other views."""

import numpy as np
from numba import njit

_FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


@njit(**_FAST)
def relative_depths(
    points, rotation, translation, lens, depth, confidence, ratio, found_confidence
):
    """Ratio z / depth of each point at its pixel of a view, and that pixel's confidence.

    ``points`` (n, 3) float32 in any frame that (rotation, translation) takes to the view's camera;
    ``lens`` = (fx, fy, cx, cy). Points behind the camera, outside the image or on a pixel without
    depth get ratio 0 and confidence 0.
    """
    h, w = depth.shape
    for i in range(points.shape[0]):
        ratio[i] = np.float32(0.0)
        found_confidence[i] = np.float32(0.0)
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
            found_confidence[i] = confidence[int(v), int(u)]


@njit(**_FAST)
def splat_depth(points, confidence, rotation, translation, lens, least, depth, weight):
    """Nearest points of another view per pixel of this one, each covering 2 x 2 pixels.

    Points as in ``relative_depths``, those with ``confidence`` of at least ``least``. Writes their
    z and confidence into ``depth`` and ``weight``, which stay as they are where no point falls.
    """
    h, w = depth.shape
    for i in range(points.shape[0]):
        if not confidence[i] >= least:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if not cz > np.float32(1e-4):
            continue
        cx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        cy = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        left = np.floor(lens[0] * cx / cz + lens[2])
        top = np.floor(lens[1] * cy / cz + lens[3])
        if not (left >= -1 and top >= -1 and left < w and top < h):
            continue
        for v in range(max(int(top), 0), min(int(top) + 2, h)):
            for u in range(max(int(left), 0), min(int(left) + 2, w)):
                if depth[v, u] == np.float32(0.0) or cz < depth[v, u]:
                    depth[v, u] = cz
                    weight[v, u] = confidence[i]


@njit(**_FAST)
def agree_on_depth(depths, weights, mask, reach, clearance, penalty, best, score):
    """The best of several depths of each pixel in a ``mask``; 0 for none and outside the mask.

    depths, weights (n, h, w); mask (h, w). A depth's score is the sum of weights of those near it
    (Gaussian, relative ``reach``) less ``penalty`` times those more than ``clearance`` in front of
    it.
    """
    n, h, w = depths.shape
    one = np.float32(1.0)
    for y in range(h):
        for x in range(w):
            top = np.float32(0.0)
            winner = np.float32(0.0)
            for j in range(n if mask[y, x] else 0):
                d = depths[j, y, x]
                if d <= np.float32(0.0):
                    continue
                votes = np.float32(0.0)
                for k in range(n):
                    e = depths[k, y, x] / d - one
                    if depths[k, y, x] > np.float32(0.0):
                        near = e / reach
                        votes += weights[k, y, x] * np.exp(np.float32(-0.5) * near * near)
                        if e < -clearance:
                            votes -= penalty * weights[k, y, x]
                if votes > top:
                    top = votes
                    winner = d
            best[y, x] = winner
            score[y, x] = top
