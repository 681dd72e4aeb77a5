"""The inner loop of averaging a depth map into a volume on the CPU, in numba."""

import numpy as np
from numba import njit

_ONE, _TWO, _NEAREST = np.float32(1), np.float32(2), np.float32(1e-6)


@njit(cache=True, nogil=True, error_model="numpy")
def average_in(slots, block, local, table, truncation, width, height, distance, weight):
    """Update the voxels of some blocks (k,) of ``distance`` and ``weight`` (blocks, voxels).

    ``block`` (k, 3) and ``local`` (3, voxels) add up to a voxel's u z, v z and z in the image;
    ``table`` (pixels, 4) and ``truncation`` (pixels), in map units, are those of ``PixelPlanes``.
    """
    for k in range(len(slots)):
        slot = slots[k]
        for j in range(local.shape[1]):
            z = block[k, 2] + local[2, j]
            if not z > _NEAREST:
                continue
            inverse = _ONE / z
            u = (block[k, 0] + local[0, j]) * inverse
            v = (block[k, 1] + local[1, j]) * inverse
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
