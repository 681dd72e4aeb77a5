"""A flow operator that is blind where images are black: for masks that each image brings along."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.tracking.flow.base import FlowOperator, Memories
from geogs.types import FlowMatch
from geogs.world.grid import STRIDE, SampleGrid


def shown_pixels(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that are not painted over."""
    return image.max(-1) > 0


@dataclass(frozen=True, eq=False)
class _Painted:
    """An encoded image and what of it may be matched."""

    encoded: Any
    shown: Float[Tensor, "h w"]
    cells: Float[Tensor, "p"]


class PaintedFlow:
    """Another operator whose matches from and to what is black in an image have no weight.

    Operators match patches, so a cell counts as hidden if anything within a cell's width is.
    """

    def __init__(self, operator: FlowOperator, grid: SampleGrid) -> None:
        self._operator = operator
        self._device = grid.device
        self._x, self._y = grid.pixels.long().unbind(-1)

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> _Painted:
        """As the operator's, with what is shown."""
        around = np.ones((2 * STRIDE + 1, 2 * STRIDE + 1), np.uint8)
        inside = cv2.erode(shown_pixels(image).astype(np.uint8), around, borderValue=1)
        shown = torch.from_numpy(inside).float().to(self._device)
        return _Painted(self._operator.encode(image), shown, shown[self._y, self._x])

    def texture(self, encoded: _Painted) -> float:
        """As the operator's, of what is not hidden at most."""
        return min(self._operator.texture(encoded.encoded), float(encoded.cells.mean()))

    def grey(self, encoded: _Painted) -> Float[Tensor, "h w"]:
        """As the operator's."""
        return self._operator.grey(encoded.encoded)

    def measure(
        self,
        first: Sequence[_Painted],
        second: Sequence[_Painted],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        """As the operator's, without what is hidden."""
        a, b = ([e.encoded for e in side] for side in (first, second))
        there, back = self._operator.measure(a, b, forward, backward, fine, memory)
        return _blinded(there, first, second), _blinded(back, second, first)


def _blinded(match: FlowMatch, source: Sequence[_Painted], target: Sequence[_Painted]) -> FlowMatch:
    height, width = source[0].shown.shape
    x, y = match.pixels.nan_to_num(0.0, 0.0, 0.0).round().long().unbind(-1)
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    shown = torch.stack([
        a.cells * b.shown[y[n], x[n]] for n, (a, b) in enumerate(zip(source, target, strict=True))
    ])  # fmt: skip
    return replace(match, weight=match.weight * shown[..., None].to(match.weight))
