"""Rasterizers at rest, so that a loop that renders again and again allocates no buffers."""

from collections import deque
from dataclasses import dataclass, field

import torch

from geogs.geometry.camera import Camera
from geogs.splat.cuda.rasterize import Rasterizer

_KEPT = 4
"""Rasterizers at rest; those used longest ago are dropped."""


@dataclass(frozen=True)
class _Key:
    """What two renderings must share to use the same buffers one after the other."""

    disks: int
    views: int
    camera: Camera
    near: float
    device: torch.device
    stream: int


@dataclass
class RasterizerPool:
    """Lends rasterizers; each comes back when its loan is given up."""

    _resting: deque[tuple[_Key, Rasterizer]] = field(default_factory=lambda: deque(maxlen=_KEPT))

    def lend(
        self, disks: int, views: int, camera: Camera, near: float, device: torch.device
    ) -> "Loan":
        """A rasterizer for the current stream, whose order keeps its uses apart."""
        stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
        key = _Key(disks, views, camera, near, device, stream)
        for entry in list(self._resting):
            if entry[0] == key:
                try:
                    self._resting.remove(entry)
                except ValueError:  # another thread was faster
                    continue
                return Loan(self, *entry)
        return Loan(self, key, Rasterizer(disks, views, camera, near, device))

    def take_back(self, key: _Key, rasterizer: Rasterizer) -> None:
        """Keep a rasterizer for the next rendering of its kind."""
        self._resting.append((key, rasterizer))


class Loan:
    """Holds a rasterizer as long as its rendering may still be differentiated."""

    def __init__(self, pool: RasterizerPool, key: _Key, rasterizer: Rasterizer) -> None:
        self.rasterizer = rasterizer
        self._pool, self._key = pool, key

    def __del__(self) -> None:
        self._pool.take_back(self._key, self.rasterizer)
