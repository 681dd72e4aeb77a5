"""Free space: the voxels of a volume that were seen to lie well in front of any surface."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from geogs.mesh.volume.tsdf import BLOCK, LIMIT, SparseTsdf, pack

FREE = 0.5
"""Least distance to a surface, as a fraction of the truncation; nearer may be its noise."""


@dataclass(frozen=True)
class FreeSpace:
    """A bit for every voxel of a volume, which takes a 64th of the volume's memory."""

    voxel: float
    """Side of a voxel, map units."""
    keys: Int[np.ndarray, "k"]
    """Keys of the blocks, ascending, as ``pack`` makes them."""
    bits: UInt8[np.ndarray, "k 64"]

    @staticmethod
    def of(tsdf: SparseTsdf, min_weight: float) -> "FreeSpace":
        """Free voxels of the blocks that belong to the box of a volume."""
        own = tsdf.owns(tsdf.coordinates)
        is_free = ((tsdf.weight >= min_weight) & (tsdf.distance > FREE))[own].flatten(1)
        bit = 2 ** torch.arange(7, -1, -1, dtype=torch.uint8, device=tsdf.device)
        bits = (is_free.unflatten(1, (-1, 8)) * bit).sum(-1, dtype=torch.uint8).cpu().numpy()
        keys = pack(tsdf.coordinates[own]).cpu().numpy()
        order = np.argsort(keys)
        return FreeSpace(tsdf.voxel, keys[order], bits[order])

    @staticmethod
    def joined(parts: Sequence["FreeSpace"]) -> "FreeSpace":
        """Free voxels of volumes with the same grid that share no block; at least one volume."""
        keys = np.concatenate([part.keys for part in parts])
        bits = np.concatenate([part.bits for part in parts])
        order = np.argsort(keys)
        return FreeSpace(parts[0].voxel, keys[order], bits[order])

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Whether the voxel nearest to each point is free; false if there is none."""
        if not len(self.keys) or not len(points):
            return np.zeros(len(points), bool)
        voxel = np.rint(points / self.voxel).astype(np.int64)
        block = np.floor_divide(voxel, BLOCK)
        limit = LIMIT // BLOCK  # the range of pack
        keys = pack(torch.from_numpy(block.clip(-limit, limit))).numpy()
        place = np.searchsorted(self.keys, keys).clip(max=len(self.keys) - 1)
        known = (self.keys[place] == keys) & (np.abs(voxel) < LIMIT).all(axis=1)
        x, y, z = (voxel - block * BLOCK).T
        number = (x * BLOCK + y) * BLOCK + z
        bit = self.bits[place, number >> 3] >> (7 - (number & 7)) & 1
        return known & (bit == 1)
