"""A flow operator that matches nothing from and to pixels that are masked out."""

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
    """Valid mask of an image that brings its own along: pixels masked out are black."""
    return image.max(-1) > 0


@dataclass(frozen=True, eq=False)
class ValidMask:
    """Valid mask of an image; 1 and 0, on the device of the grid."""

    pixels: Float[Tensor, "h w"]
    """Without what is nearer than a cell to pixels masked out: operators match patches."""
    cells: Float[Tensor, "p"]

    @property
    def fraction(self) -> float:
        """Fraction of the cells that are valid."""
        return float(self.cells.mean())


@dataclass(frozen=True, eq=False)
class MaskedImage:
    """An encoded image and what of it may be matched."""

    encoded: Any
    valid: ValidMask


class MaskedFlow:
    """Another operator whose matches from and to what is masked out have no weight."""

    def __init__(
        self,
        operator: FlowOperator,
        grid: SampleGrid,
        mask: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """``mask``, of the size of the images, is true where all of them show the scene (a car's
        bonnet, an arm, a time stamp are not); None where what is black in an image is masked out.

        Raises InputError if it has another size, or hides all.
        """
        self._operator, self._device = operator, grid.device
        self._x, self._y = grid.pixels.long().unbind(-1)
        self.fixed: ValidMask | None = None
        """The mask of all images."""
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
        """The operator's form of an image, with what is valid."""
        valid = self.fixed or self._valid(valid_pixels(image))
        return MaskedImage(self._operator.encode(image), valid)

    def texture(self, encoded: MaskedImage) -> float:
        """The operator's, at most the fraction of cells that are valid."""
        return min(self._operator.texture(encoded.encoded), encoded.valid.fraction)

    def grey(self, encoded: MaskedImage) -> Float[Tensor, "h w"]:
        """The operator's."""
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
        """The operator's matches, without what is masked out."""
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
        if self.fixed:
            valid = self.fixed.cells * self.fixed.pixels[y, x]
        else:
            valid = torch.stack([
                a.valid.cells * b.valid.pixels[v, u]
                for a, b, u, v in zip(source, target, x, y, strict=True)
            ])  # fmt: skip
        return replace(match, weight=match.weight * valid[..., None].to(match.weight))
