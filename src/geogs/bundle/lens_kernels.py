"""Compiled loops over the cells of a source that are seen through a lens in its targets.

Arrays are C-contiguous and float32, except sums over cells, which are float64: motions to the
targets (e, 3, 4), rays of the cells (2, p) with z = 1, the lens (6) as fx, fy, cx, cy, k1 and k2,
and more of it or None (:mod:`geogs.geometry.bend_kernels`), inverse depths (p), measured positions
and their weights (e, p, 2). The kernels release the interpreter lock. Chains of small PyTorch
operations take ten times as long, and threads that call them wait for each other.
"""

import numpy as np
from numba import njit

from geogs.geometry.bend_kernels import FAST as _FAST
from geogs.geometry.bend_kernels import aside_at, growth_at
from geogs.kernel_parts import inlined

_PART = inlined(_FAST)
_BLOCK = 64
"""Cells whose derivatives are computed at a time: they fit into the L1 cache."""
_ZERO, _ONE, _TWO = map(np.float32, range(3))


@njit(**_PART)
def _seen(motion, x, y, d, nearest):
    """Project a cell into a target: x / z and y / z, 1 / z, and whether it is in front."""
    X = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] + motion[0, 3] * d
    Y = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] + motion[1, 3] * d
    Z = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] + motion[2, 3] * d
    q = _ONE / (nearest if nearest > Z else Z)
    return X * q, Y * q, q, nearest < Z


@njit(**_PART)
def _dot(left, right):
    """Return the scalar product of two blocks."""
    total = _ZERO
    for n in range(2 * _BLOCK):
        total += left[n] * right[n]
    return total


@njit(**_PART)
def _derivatives(motion, rays, slopes, lens, more, inverse_depth, pixels, weight, limits, J, r, w):
    """Compute derivatives of some cells for :func:`linearise_source`: the x of all, then the y. The
    last row of ``J`` is by the inverse depth."""
    huber = limits[0]
    nearest = limits[1]
    fx = lens[0]
    fy = lens[1]
    cx = lens[2]
    cy = lens[3]
    k1 = lens[4]
    k2 = lens[5]
    first, second = J[:, :_BLOCK], J[:, _BLOCK:]
    shapes = len(slopes)
    last = len(J) - 1
    tx, ty, tz = motion[0, 3], motion[1, 3], motion[2, 3]
    for n in range(rays.shape[1]):
        x = rays[0, n]
        y = rays[1, n]
        d = inverse_depth[n]
        u, v, q, is_front = _seen(motion, x, y, d, nearest)
        square = u * u + v * v
        growth, bent, by_k1, by_k2, is_shown = growth_at(square, k1, k2, more)
        aside_x, aside_y, aside_xx, aside_xy, aside_yy = aside_at(u, v, more)
        # d pixel / d (u, v)
        both = bent * u * v + aside_xy
        xx, xy = fx * (growth + bent * u * u + aside_xx), fx * both
        yx, yy = fy * both, fy * (growth + bent * v * v + aside_yy)
        dq = d * q
        first[0, n] = xx * dq
        second[0, n] = yx * dq
        first[1, n] = xy * dq
        second[1, n] = yy * dq
        a, b = -u * dq, -v * dq
        first[2, n] = xx * a + xy * b
        second[2, n] = yx * a + yy * b
        a, b = -u * v, -_ONE - v * v
        first[3, n] = xx * a + xy * b
        second[3, n] = yx * a + yy * b
        a, b = _ONE + u * u, u * v
        first[4, n] = xx * a + xy * b
        second[4, n] = yx * a + yy * b
        first[5, n] = xy * u - xx * v
        second[5, n] = yy * u - yx * v
        a, b = (tx - tz * u) * q, (ty - tz * v) * q
        first[last, n] = xx * a + xy * b
        second[last, n] = yx * a + yy * b
        if shapes:
            # A change of the lens moves the ray along (x, y, 0).
            z = motion[2, 0] * x + motion[2, 1] * y
            a = (motion[0, 0] * x + motion[0, 1] * y - z * u) * q
            b = (motion[1, 0] * x + motion[1, 1] * y - z * v) * q
            along = xx * a + xy * b
            across = yx * a + yy * b
            own_x, own_y = fx * u, fy * v
            first[6, n] = along * slopes[0, n] + own_x * growth + fx * aside_x
            second[6, n] = across * slopes[0, n] + own_y * growth + fy * aside_y
            first[7, n] = along * slopes[1, n] + own_x * by_k1
            second[7, n] = across * slopes[1, n] + own_y * by_k1
            first[8, n] = along * slopes[2, n] + own_x * by_k2
            second[8, n] = across * slopes[2, n] + own_y * by_k2
        a = pixels[n, 0] - (fx * (u * growth + aside_x) + cx)
        b = pixels[n, 1] - (fy * (v * growth + aside_y) + cy)
        is_front = is_front and is_shown
        wx = weight[n, 0] if is_front else _ZERO
        wy = weight[n, 1] if is_front else _ZERO
        norm = np.sqrt(wx * a * a + wy * b * b)
        robust = huber / (huber if norm < huber else norm)
        r[n] = a
        r[_BLOCK + n] = b
        w[n] = wx * robust
        w[_BLOCK + n] = wy * robust


@njit(**_FAST)
def linearise_source(
    motions, rays, slopes, lens, more, inverse_depth, pixels, weight, further, limits,
    hessian, gradient, coupling, curvature, pull,
):  # fmt: skip
    """Add the equations of all edges of a source to the output arrays.

    Unknowns are the motions to all targets (6e, left perturbations), then the shared ones: the
    logarithm of the focal length, k1 and k2 if there are ``slopes`` (3, p) of the rays by them, and
    those with derivatives ``further`` (e, o, p, 2) of the cells' positions. ``limits`` are the
    Huber threshold, in deviations, and the least z. Outputs are ``hessian`` (m, m) and ``gradient``
    (m), the direction of descent; ``coupling`` (m, p) with the inverse depths, and their
    ``curvature`` (p) and gradient ``pull`` (p).
    """
    edges = weight.shape[0]
    cells = weight.shape[1]
    shapes = len(slopes)
    others = further.shape[1]
    count = 6 + shapes + others
    J = np.zeros((count + 1, 2 * _BLOCK), np.float32)
    r = np.zeros(2 * _BLOCK, np.float32)
    w = np.zeros(2 * _BLOCK, np.float32)
    wJ = np.zeros(2 * _BLOCK, np.float32)
    rows = np.empty(count, np.int64)
    for e in range(edges):
        for k in range(count):
            rows[k] = 6 * e + k if k < 6 else 6 * (edges - 1) + k
        for begin in range(0, cells, _BLOCK):
            end = min(begin + _BLOCK, cells)
            size = end - begin
            _derivatives(
                motions[e],
                rays[:, begin:end],
                slopes[:, begin:end],
                lens,
                more,
                inverse_depth[begin:end],
                pixels[e, begin:end],
                weight[e, begin:end],
                limits,
                J,
                r,
                w,
            )
            w[size:_BLOCK] = _ZERO
            w[_BLOCK + size :] = _ZERO
            for k in range(others):
                for n in range(size):
                    J[6 + shapes + k, n] = further[e, k, begin + n, 0]
                    J[6 + shapes + k, _BLOCK + n] = further[e, k, begin + n, 1]
            depth = J[count]
            for k in range(count + 1):
                for n in range(2 * _BLOCK):
                    wJ[n] = J[k, n] * w[n]
                if k == count:
                    out = curvature[begin:end]
                else:
                    out = coupling[rows[k], begin:end]
                    gradient[rows[k]] += _dot(wJ, r)
                    for other in range(k + 1):
                        hessian[rows[k], rows[other]] += _dot(wJ, J[other])
                for n in range(size):
                    out[n] += wJ[n] * depth[n] + wJ[_BLOCK + n] * depth[_BLOCK + n]
            for n in range(size):
                pull[begin + n] += wJ[n] * r[n] + wJ[_BLOCK + n] * r[_BLOCK + n]
    for k in range(len(hessian)):
        for other in range(k):
            hessian[other, k] = hessian[k, other]


@njit(**_FAST)
def cost_of_source(motions, rays, lens, more, inverse_depth, pixels, weight, limits, behind):
    """Return Huber's cost of a source's matched cells; ``behind`` is used behind their target."""
    knee = limits[0]
    nearest = limits[1]
    fx = lens[0]
    fy = lens[1]
    cx = lens[2]
    cy = lens[3]
    k1 = lens[4]
    k2 = lens[5]
    total = 0.0
    for e in range(len(weight)):
        motion = motions[e]
        for n in range(weight.shape[1]):
            if not weight[e, n, 0] > _ZERO:
                continue
            u, v, _, is_front = _seen(motion, rays[0, n], rays[1, n], inverse_depth[n], nearest)
            square = u * u + v * v
            growth, _, _, _, is_shown = growth_at(square, k1, k2, more)
            aside_x, aside_y, _, _, _ = aside_at(u, v, more)
            a = pixels[e, n, 0] - (fx * (u * growth + aside_x) + cx)
            b = pixels[e, n, 1] - (fy * (v * growth + aside_y) + cy)
            error = weight[e, n, 0] * a * a + weight[e, n, 1] * b * b
            if not (is_front and is_shown):
                error = behind
            total += (
                error if not error > knee * knee else _TWO * knee * np.sqrt(error) - knee * knee
            )
    return total
