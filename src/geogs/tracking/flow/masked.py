"""A flow operator without matches from and to masked-out pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.tracking.flow.flow_operator import FlowOperator, Memories
from geogs.types import FlowMatch
from geogs.world.grid import STRIDE, SampleGrid


def valid_pixels(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Return the valid mask of an image whose masked-out pixels are black."""
    return image.max(-1) > 0


@dataclass(frozen=True, eq=False)
class ValidMask:
    """Valid mask of an image; 1 and 0, on the device of the grid."""

    pixels: Float[Tensor, "h w"]
    """Valid pixels at least a cell away from masked-out ones, as operators match patches."""
    cells: Float[Tensor, "p"]

    @property
    def fraction(self) -> float:
        """Fraction of the cells that are valid."""
        return float(self.cells.mean())


@dataclass(frozen=True, eq=False)
class MaskedImage:
    """An encoded image and its valid mask."""

    encoded: Any
    valid: ValidMask


class MaskedFlow:
    """Wraps an operator; matches from and to masked-out pixels get no weight."""

    def __init__(
        self, operator: FlowOperator, grid: SampleGrid, mask: Bool[np.ndarray, "h w"] | None = None
    ) -> None:
        """``mask``, of the size of the images, is true where all of them show the scene (not a
        car's bonnet, an arm, a time stamp); None masks out black pixels of each image.

        Raises InputError if it has another size, or hides all.
        """
        self._operator = operator
        self._device = grid.device
        self._x, self._y = grid.pixels.long().unbind(-1)
        self.fixed: ValidMask | None = None
        """Mask of all images."""
        if mask is None:
            return
        size = grid.camera.height, grid.camera.width
        if mask.shape != size:
            raise InputError(
                f"The mask is {mask.shape[1]} x {mask.shape[0]} pixels, the images are "
                f"{size[1]} x {size[0]}."
            )
        self.fixed = self._valid(mask)
        if self.fixed.fraction == 0:
            raise InputError("The mask hides the whole image; it is bright where the scene is.")

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> MaskedImage:
        """Encode an image, with its valid mask."""
        valid = self.fixed or self._valid(valid_pixels(image))
        return MaskedImage(self._operator.encode(image), valid)

    def texture(self, encoded: MaskedImage) -> float:
        """Return the textured fraction, at most the fraction of valid cells."""
        return min(self._operator.texture(encoded.encoded), encoded.valid.fraction)

    def grey(self, encoded: MaskedImage) -> Float[Tensor, "h w"]:
        """Return the image in grey levels."""
        return self._operator.grey(encoded.encoded)

    def measure(
        self,
        first: Sequence[MaskedImage],
        second: Sequence[MaskedImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        """Return the operator's matches, without masked-out pixels."""
        a, b = ([image.encoded for image in side] for side in (first, second))
        there, back = self._operator.measure(a, b, forward, backward, fine, memory)
        return self._masked(there, first, second), self._masked(back, second, first)

    def _valid(self, mask: Bool[np.ndarray, "h w"]) -> ValidMask:
        around = np.ones((2 * STRIDE + 1, 2 * STRIDE + 1), np.uint8)
        inside = cv2.erode(mask.astype(np.uint8), around, borderValue=1)
        pixels = torch.from_numpy(inside).float().to(self._device)
        return ValidMask(pixels, pixels[self._y, self._x])

    def _masked(
        self, match: FlowMatch, source: Sequence[MaskedImage], target: Sequence[MaskedImage]
    ) -> FlowMatch:
        height, width = target[0].valid.pixels.shape
        x, y = match.pixels.nan_to_num(0.0, 0.0, 0.0).round().long().unbind(-1)
        x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        valid = torch.stack(
            [
                a.valid.cells * b.valid.pixels[v, u]
                for a, b, u, v in zip(source, target, x, y, strict=True)
            ]
        )
        return replace(match, weight=match.weight * valid[..., None].to(match.weight))
