"""Order of cells along the Z-order curve, in which neighbours in space are mostly near."""

import numpy as np
from jaxtyping import Int, Shaped


def morton_codes(cells: Shaped[np.ndarray, "n 3"], bits: int) -> Int[np.ndarray, "n"]:
    """Places along the curve: the bits of the three whole, non-negative coordinates interleaved.

    At most 21 bits each.
    """
    code = np.zeros(len(cells), np.int64)
    for bit in range(bits):
        for axis in range(3):
            code |= ((cells[:, axis].astype(np.int64) >> bit) & 1) << (3 * bit + axis)
    return code
