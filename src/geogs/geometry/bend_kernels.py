"""Compiled distortion of a point x / z, y / z, to be inlined into the loops over cells.

The same functions as those of :class:`geogs.geometry.camera.Camera`. ``k1`` and ``k2`` alone are
the usual case; ``more`` is None then, and the rest is not compiled. Else it holds p1, p2, k3, k4,
k5, k6, and 1 for a fisheye. All are float32.
"""

from typing import Any

import numpy as np
from jaxtyping import Float32
from numba import njit

from geogs.geometry.camera import LEAST_SLOPE, Camera
from geogs.kernel_parts import inlined

FAST: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},  # non-finite values have to be kept
}
_PART = inlined(FAST)
_ZERO, _ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX, _SEVEN = map(np.float32, range(8))
_NINE = np.float32(9)
_LEAST_SLOPE = np.float32(LEAST_SLOPE)
_CENTRAL = np.float32(1e-4)


def lens_arguments(
    camera: Camera,
) -> tuple[Float32[np.ndarray, "6"], Float32[np.ndarray, "7"] | None]:
    """Return fx, fy, cx, cy, k1, k2, and ``more``."""
    numbers = np.array(camera.numbers, np.float32)
    return numbers[:6], numbers[6:] if numbers[6:].any() else None


@njit(**_PART)
def growth_at(square, k1, k2, more):
    """Compute the growth of the radius, twice its derivative by the squared radius, its derivatives
    by k1 and k2, and the slope that is small where the image folds over."""
    growth = _ONE + square * (k1 + square * k2)
    slope = _TWO * k1 + _FOUR * k2 * square
    first = square
    second = square * square
    steepness = _ONE + square * (_THREE * k1 + _FIVE * square * k2)
    if more is not None:
        k3 = more[2]
        k4 = more[3]
        if more[6] > _ZERO:
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            s = angle * angle
            straight = angle / radius if square > _ZERO else _ONE
            growth = straight * (_ONE + s * (k1 + s * (k2 + s * (k3 + s * k4))))
            first = straight * s
            second = first * s
            steepness = _ONE + s * (
                _THREE * k1 + s * (_FIVE * k2 + s * (_SEVEN * k3 + s * _NINE * k4))
            )
            if square > _CENTRAL:
                slope = (steepness / (_ONE + square) - growth) / square
            else:
                slope = _TWO * k1 - _TWO / _THREE
        else:
            k5 = more[4]
            k6 = more[5]
            under = _ONE + square * (k4 + square * (k5 + square * k6))
            growth = (growth + square * square * square * k3) / under
            slope += _SIX * square * square * k3
            slope -= growth * (_TWO * k4 + square * (_FOUR * k5 + _SIX * square * k6))
            slope /= under
            first /= under
            second /= under
            steepness = growth + square * slope
    return growth, slope, first, second, steepness > _LEAST_SLOPE


@njit(**_PART)
def aside_at(u, v, more):
    """Compute the tangential distortion of a point, and its derivatives: of x by x, of either by
    the other, of y by y."""
    x = y = xx = xy = yy = _ZERO
    if more is not None:
        p1 = more[0]
        p2 = more[1]
        x = _TWO * p1 * u * v + p2 * (_THREE * u * u + v * v)
        y = p1 * (u * u + _THREE * v * v) + _TWO * p2 * u * v
        xx = _TWO * p1 * v + _SIX * p2 * u
        xy = _TWO * p1 * u + _TWO * p2 * v
        yy = _SIX * p1 * v + _TWO * p2 * u
    return x, y, xx, xy, yy
