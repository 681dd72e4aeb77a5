"""Grey values between pixels: each pixel with its right neighbour in one word, fetched by index.

No processor that we know gathers pixels faster than by single loads, so that the loop over a row
only copies words, two a sample, and the computation is left to loops that the compiler vectorises.
"""

import numpy as np
from numba import njit

from geogs.kernel_parts import inlined

_PART = inlined({"nogil": True, "fastmath": True, "error_model": "numpy"})


def pixel_pairs(images: np.ndarray) -> np.ndarray:
    """Words (n, h, w) of 64 bits, each of a float32 pixel (n, h, w) and the one to its right; the
    last of a row is repeated."""
    pairs = np.empty((*images.shape, 2), np.float32)
    pairs[..., 0] = images
    pairs[..., :-1, 1] = images[..., 1:]
    pairs[..., -1, 1] = images[..., -1]
    return pairs.view(np.uint64)[..., 0]


@njit(**_PART)
def fetch_pairs(pairs, index, top, low):
    """The pairs (h, w) at the flat indices of a row of samples, and those one row below."""
    flat = pairs.ravel()
    down = np.uint32(pairs.shape[1])
    for x in range(index.shape[0]):
        k = index[x]
        top[x] = flat[k]
        low[x] = flat[k + down]
