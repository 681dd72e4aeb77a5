"""The inner loop of averaging a depth map into a volume on the CPU, in numba."""

import numpy as np
from numba import njit

_ONE, _TWO, _NEAREST = np.float32(1), np.float32(2), np.float32(1e-6)


@njit(cache=True, nogil=True, error_model="numpy")
def average_in(
    slots, block, local, corner, step, middle, radius,
    table, truncation, width, height, distance, weight,
):  # fmt: skip
    """Update the voxels of some blocks (k,) of ``distance`` and ``weight`` (blocks, voxels).

    ``block`` (k, 3) and ``local`` (3, voxels) add up to a voxel's u z, v z and z in the image;
    ``corner`` (k, 3) and ``step`` (3, voxels) to its position from the centre of a ``Contraction``
    with a ``radius``, which may be infinite; ``middle`` (3) has u z, v z and z of that centre.
    ``table`` (pixels, 4) and ``truncation`` (pixels), in map units, are those of ``PixelPlanes``.
    """
    is_contracted = np.isfinite(radius)
    for k in range(len(slots)):
        slot = slots[k]
        for j in range(local.shape[1]):
            x, y = block[k, 0] + local[0, j], block[k, 1] + local[1, j]
            z = block[k, 2] + local[2, j]
            if is_contracted:
                a, b = corner[k, 0] + step[0, j], corner[k, 1] + step[1, j]
                c = corner[k, 2] + step[2, j]
                away = np.sqrt(a * a + b * b + c * c) / radius
                if not away < _TWO - _NEAREST:
                    continue
                if away > _ONE:
                    stretch = _ONE / (away * (_TWO - away))
                    x = middle[0] + stretch * (x - middle[0])
                    y = middle[1] + stretch * (y - middle[1])
                    z = middle[2] + stretch * (z - middle[2])
            if not z > _NEAREST:
                continue
            inverse = _ONE / z
            u, v = x * inverse, y * inverse
            column, row = np.rint(u), np.rint(v)
            if not (column >= 0 and row >= 0 and column < width and row < height):
                continue
            pixel = np.int64(row) * width + np.int64(column)
            plane = table[pixel]
            surface = plane[0] + plane[1] * (u - column) + plane[2] * (v - row)
            ahead = (_ONE / surface - z) / truncation[pixel]
            if not ahead > -_ONE:
                continue
            gain = plane[3] * min(_TWO + _TWO * ahead, _ONE)
            if not gain > 0:
                continue
            new = weight[slot, j] + gain
            change = min(ahead, _ONE) - distance[slot, j]
            distance[slot, j] += change * (gain / new)
            weight[slot, j] = new
