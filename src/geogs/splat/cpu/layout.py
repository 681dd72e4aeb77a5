"""What the kernels share: layouts, constants, compiler options and an exponential.

A disk's *record* holds what a pixel needs to know about it, in float32. With (dx, dy) the pixel's
offset from the projected centre, the plane's inverse depth is w = Wx dx + Wy dy + Wc and the hit's
coordinates on the disk are (Ux dx + Uy dy, Vx dx + Vy dy) / w, in units of sqrt(2) deviations, so
that the Gaussian is exp(-min(u^2 + v^2, dx^2 + dy^2)).

A *tile* is a block of pixels whose state lies in one float32 array, one plane per quantity. Some
neighbouring rows of a tile are one run of memory, so one loop without branches goes over them, and
the compiler turns it into vector instructions of 16 lanes (AVX-512) or 8 (AVX2): two rows or one at
a time. A *pair* is a disk and a tile that its box touches.
"""

import numba
import numpy as np

TILE_WIDTH = 8
TILE_HEIGHT = 32
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
LANES = 16
"""Runs of pixels start and end at multiples of this."""

RECORD = 16
"""Floats per record: one cache line."""
MX, MY, UX, UY, VX, VY, WX, WY, WC, OPACITY, NX, NY, NZ, Z_NEAREST, Z_FURTHEST = range(15)

GRADIENT = 16
"""Floats per pair that the backward pass sums over pixels."""
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
MIN_FACING = 1e-4
MIN_HIT_RATIO = np.float32(1e-4)
MAX_REACH_RATIO = 1e3

ZERO = np.float32(0)
HALF = np.float32(0.5)
ONE = np.float32(1)
TWO = np.float32(2)

PER_DISK = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
PER_PIXEL = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "nsz", "arcp", "contract", "afn", "nnan", "ninf"},
}
"""Reassociation lets sums be vectorised; finite records keep NaN and infinity out of the pixels."""

_LOG2_E = np.float32(1.442695041)
_LN2_HIGH = np.float32(0.693359375)
_LN2_LOW = np.float32(-2.12194440e-4)
_MAX_EXPONENT = np.float32(80)
_C0, _C1, _C2, _C3, _C4 = (
    np.float32(c)
    for c in (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1)
)


@numba.njit(inline="always", error_model="numpy", fastmath=PER_PIXEL["fastmath"])
def exp_minus(x):
    """exp(-x) of a float32 x >= 0, relative error 1e-7; vectorises where a library call does not.

    Cephes' expf: a power of two times a polynomial.
    """
    y = -min(x, _MAX_EXPONENT)
    n = np.int32(y * _LOG2_E - HALF)
    whole = np.float32(n)
    r = y - whole * _LN2_HIGH - whole * _LN2_LOW
    p = ((((_C0 * r + _C1) * r + _C2) * r + _C3) * r + _C4) * r + HALF
    p = p * r * r + r + ONE
    return p * np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)
