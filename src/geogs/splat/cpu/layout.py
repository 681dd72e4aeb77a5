"""Layouts, constants, compiler options and an exponential, shared by the kernels.

A disk's *record* holds the data of it that a pixel needs, in float32. With (dx, dy) the pixel's
offset from the projected centre, the plane's inverse depth is w = Wx dx + Wy dy + Wc and the hit's
coordinates on the disk are (Ux dx + Uy dy, Vx dx + Vy dy) / w, in units of sqrt(2) deviations, so
that the Gaussian is exp(-min(u^2 + v^2, dx^2 + dy^2)).

A *tile* is a block of pixels whose state lies in one float32 array, one plane per quantity. Some
neighbouring rows of a tile are one run of memory, so one loop without branches goes over them, and
the compiler turns it into vector instructions of 16 lanes (AVX-512) or 8 (AVX2): two rows or one at
a time. A *pair* is a disk and a tile that its box touches.
"""

from typing import Any

import numba
import numpy as np

TILE_WIDTH = 8
TILE_HEIGHT = 64
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
LANES = 16
"""Pixels per run."""
ROWS_PER_RUN = LANES // TILE_WIDTH
PLANE = TILE_PIXELS + LANES
"""Floats from one plane of a tile's state to the next. Were that a power of two, the same pixel of
all planes would lie in one or two sets of the first cache, and push each other out of it."""

OUTLINE = 10
"""Numbers (float64) that bound the pixels of a disk: an ellipse about MIDDLE and a circle of radius
BLUR about the projected CENTER. At x from MIDDLE the ellipse spans
SLOPE x +- SIDE sqrt(1 - (x / HALF_X)^2); its highest point, y = HALF_Y, is at x = TOP."""
(CENTER_X, CENTER_Y, BLUR, MIDDLE_X, MIDDLE_Y, HALF_X, HALF_Y, SLOPE, SIDE, TOP) = range(10)

MARGIN = 0.01
"""Pixels by which outlines are widened against rounding."""

RECORD = 16
"""Floats per record: one cache line."""
(MX, MY, UX, UY, VX, VY, WX, WY, WC, OPACITY, NX, NY, NZ, Z_NEAREST, Z_FURTHEST) = range(15)

GRADIENT = 16
"""Floats per list entry that the backward pass sums over pixels, in the order below."""
(
    G_U, G_UX, G_UY, G_V, G_VX, G_VY, G_W, G_WX, G_WY,
    G_CLAMPED, G_MX, G_MY, G_OPACITY, G_NX, G_NY, G_NZ,
) = range(16)  # fmt: skip

SAVED = 3
"""Planes per tile that the forward pass leaves for the backward pass."""
SAVED_LIGHT, SAVED_MOMENT, SAVED_LAST = range(3)

MIN_ALPHA = np.float32(1 / 255)
MAX_ALPHA = np.float32(0.99)
MIN_TRANSMITTANCE = np.float32(1e-4)
MIN_HIT_RATIO = np.float32(1e-4)

ZERO = np.float32(0)
HALF = np.float32(0.5)
ONE = np.float32(1)
TWO = np.float32(2)

PER_DISK: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
}
PER_PIXEL: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "nsz", "arcp", "contract", "afn", "nnan", "ninf"},
}
"""Reassociation lets sums be vectorised; finite records keep NaN and infinity out of the pixels."""

_NO_SHOW = np.float32(8)
_SIXTEENTH = np.float32(1 / 16)
# Minimax polynomial of exp(-y) on [0, 1/2], relative error 1e-8.
_C0, _C1, _C2 = np.float32(0.9999999894), np.float32(-0.9999985731), np.float32(0.4999680477)
_C3, _C4, _C5 = np.float32(-0.1664003761), np.float32(0.0406455346), np.float32(-0.0064755333)


@numba.njit(inline="always", error_model="numpy", fastmath=PER_PIXEL["fastmath"])
def exp_minus(x):
    """exp(-x) of a float32 x >= 0 with relative error 3e-6, and exp(-8) < MIN_ALPHA beyond 8.

    (exp(-x / 16))^16 by a polynomial; a library's exp is a call and would keep loops scalar.
    """
    y = min(x, _NO_SHOW) * _SIXTEENTH
    p = ((((_C5 * y + _C4) * y + _C3) * y + _C2) * y + _C1) * y + _C0
    p2 = p * p
    p4 = p2 * p2
    p8 = p4 * p4
    return p8 * p8
