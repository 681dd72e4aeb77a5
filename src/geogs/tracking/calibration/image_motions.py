"""Image motion of a view during readout, from the images next to it in the video."""

from collections import deque
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.tracking.frames.row_errors import slope_at_zero
from geogs.world.grid import SampleGrid

EITHER_SIDE, FARTHEST = 2, 0.3
"""Number of images before and after a view, and their largest distance in seconds: for an
oscillating motion the nearest alone show too little (docs/notebook/calibration.md)."""
LONG_EDGE = 256
"""Largest long edge, in pixels, of the images for flow."""


class TimedImage(NamedTuple):
    """An image of a video."""

    timestamp: float
    """Seconds."""
    image: UInt8[np.ndarray, "h w 3"]


class _Seen(NamedTuple):
    frame: int
    timestamp: float
    small: UInt8[np.ndarray, "h w"]


class ImageMotions:
    """Velocities of the cells of some images of a video, by dense inverse search (DIS)."""

    def __init__(self, grid: SampleGrid) -> None:
        self._grid = grid
        camera = grid.camera
        small = camera.with_long_edge(min(camera.long_edge, LONG_EDGE))
        self._size = (small.width, small.height)
        self._factor = small.width / camera.width
        column, row = ((grid.pixels.cpu().numpy() + 0.5) * self._factor - 0.5).round().astype(int).T
        self._cells = row.clip(0, small.height - 1), column.clip(0, small.width - 1)
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._latest = deque[_Seen](maxlen=EITHER_SIDE + 1)
        self._beside: dict[int, list[_Seen]] = {}
        """Images around each followed one, including itself."""
        self._velocities: dict[int, tuple[Tensor, Tensor]] = {}

    def see(self, frame: int, image: TimedImage) -> None:
        """Add the next image of the video."""
        grey = cv2.cvtColor(image.image, cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, self._size, interpolation=cv2.INTER_AREA)
        latest = _Seen(frame, image.timestamp, small)
        for seen in list(self._latest)[-EITHER_SIDE:]:
            if seen.frame in self._beside:
                self._beside[seen.frame].append(latest)
        self._latest.append(latest)

    def follow(self) -> None:
        """Store the neighbours of the last image."""
        self._beside[self._latest[-1].frame] = list(self._latest)

    def of(self, frame: int) -> tuple[Float[Tensor, "p 2"], Bool[Tensor, "p"]]:
        """Return the velocities of an image's cells in pixels per second, and where they are known:
        the slope of the polynomial through their positions in the neighbouring images."""
        if frame not in self._velocities:
            self._velocities[frame] = self._measured(frame)
        return self._velocities[frame]

    def _measured(self, frame: int) -> tuple[Float[Tensor, "p 2"], Bool[Tensor, "p"]]:
        grid = self._grid
        around = self._beside[frame]
        own = next(seen for seen in around if seen.frame == frame)
        away = [(seen, seen.timestamp - own.timestamp) for seen in around]
        beside = [(seen, seconds) for seen, seconds in away if 0 < abs(seconds) < FARTHEST]
        if not beside:
            return torch.zeros_like(grid.pixels), torch.zeros_like(grid.pixels[:, 0]).bool()
        times = torch.tensor([[0.0, *(seconds for _, seconds in beside)]], dtype=torch.float64)
        dense = [self._flow.calc(own.small, seen.small, None)[self._cells] for seen, _ in beside]
        flows = torch.from_numpy(np.stack([np.zeros_like(dense[0]), *dense]) / self._factor)
        slope = slope_at_zero(times, flows.double().flatten(1)[None])
        known = grid.inside(grid.pixels + flows.to(grid.pixels)).all(0)
        return slope.reshape(-1, 2).to(grid.pixels), known
