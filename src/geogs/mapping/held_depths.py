"""Depths of views that are not in use, which a GPU keeps beside their archive for a while."""

import torch

from geogs.depth.view import DenseDepth
from geogs.mapping.stored_maps import StoredDepth
from geogs.world.lru import LruCache

HELD = 512
"""Most depths; at 320 x 180 pixels with normals they take 600 MB."""


class HeldDepths:
    """The depths used last, by keyframe: bringing one to a GPU takes longer than using it.

    On a CPU none is held: the archive is as near.
    """

    def __init__(self, device: torch.device, limit: int = HELD) -> None:
        self._depths: LruCache[int, tuple[StoredDepth, DenseDepth]] = LruCache(limit)
        self._is_used = device.type == "cuda"

    def put(self, id: int, stored: StoredDepth, depth: DenseDepth) -> None:
        """Hold the depth of a keyframe, which was archived as ``stored``."""
        if self._is_used:
            self._depths.put(id, (stored, depth))

    def get(self, id: int, stored: StoredDepth, scale: float) -> DenseDepth | None:
        """What was archived as ``stored``, at a scale of its keyframe; None if it is not held."""
        entry = self._depths.peek(id)
        if entry is None or entry[0] is not stored:
            return None
        self._depths.put(id, entry)
        held, factor = entry[1], scale / stored.scale
        typical = torch.tensor(stored.typical_at(scale))
        return DenseDepth(held.depth * factor, held.confidence, typical, normal=held.normal)
