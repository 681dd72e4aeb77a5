"""Order of cells along the Z-order curve, which keeps most spatial neighbours close."""

import numpy as np
from jaxtyping import Int, Shaped


def morton_codes(cells: Shaped[np.ndarray, "n 3"], bits: int) -> Int[np.ndarray, "n"]:
    """Interleave the bits of the three whole, non-negative coordinates, at most 21 bits each."""
    code = np.zeros(len(cells), np.int64)
    for bit in range(bits):
        for axis in range(3):
            code |= ((cells[:, axis].astype(np.int64) >> bit) & 1) << (3 * bit + axis)
    return code
