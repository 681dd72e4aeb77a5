"""A flow operator that is blind for a part of all images: a car's bonnet, an arm, a time stamp."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.tracking.flow.base import FlowOperator, Memories
from geogs.types import FlowMatch
from geogs.world.grid import STRIDE, SampleGrid


class MaskedFlow:
    """Another operator whose matches from and to what a mask hides have no weight.

    Operators match patches, so a cell counts as hidden if anything within a cell's width is.
    """

    def __init__(
        self, operator: FlowOperator, grid: SampleGrid, mask: Bool[np.ndarray, "h w"]
    ) -> None:
        """``mask``, of the size of the images, is true where they show the scene.

        Raises InputError if it has another size, or hides all.
        """
        size = grid.camera.height, grid.camera.width
        if mask.shape != size:
            raise InputError(
                f"The mask is {mask.shape[1]} x {mask.shape[0]} pixels, the images are "
                f"{size[1]} x {size[0]}."
            )
        around = np.ones((2 * STRIDE + 1, 2 * STRIDE + 1), np.uint8)
        inside = cv2.erode(mask.astype(np.uint8), around, borderValue=1)
        self._operator = operator
        self._shown = torch.from_numpy(inside).float().to(grid.device)
        x, y = grid.pixels.long().unbind(-1)
        self._cells = self._shown[y, x]
        self.share = float(self._cells.mean())
        """Of the cells that are not hidden."""
        if self.share == 0:
            raise InputError("The mask hides the whole image; it is bright where the scene is.")

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> Any:
        """As the operator's."""
        return self._operator.encode(image)

    def texture(self, encoded: Any) -> float:
        """As the operator's, of what is not hidden at most."""
        return min(self._operator.texture(encoded), self.share)

    def grey(self, encoded: Any) -> Float[Tensor, "h w"]:
        """As the operator's."""
        return self._operator.grey(encoded)

    def measure(
        self,
        first: Sequence[Any],
        second: Sequence[Any],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        """As the operator's, without what is hidden."""
        there, back = self._operator.measure(first, second, forward, backward, fine, memory)
        return self._blinded(there), self._blinded(back)

    def _blinded(self, match: FlowMatch) -> FlowMatch:
        height, width = self._shown.shape
        x, y = match.pixels.nan_to_num(0.0, 0.0, 0.0).round().long().unbind(-1)
        shown = self._shown[y.clamp(0, height - 1), x.clamp(0, width - 1)] * self._cells
        return replace(match, weight=match.weight * shown[..., None].to(match.weight))
