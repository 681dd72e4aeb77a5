"""The interface of flow operators."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.types import FlowMatch

Memories = Sequence[tuple[Any, Any]]
"""Memory returned by the operator for each pair's two directions, or None."""


def check_image_size(image: UInt8[np.ndarray, "h w 3"], camera: Camera) -> None:
    """Raises InputError for an image of another size than its camera's."""
    if image.shape != (camera.height, camera.width, 3):
        raise InputError(
            f"An image of shape {image.shape} does not fit a camera of {camera.width} x "
            f"{camera.height} pixels."
        )


@runtime_checkable
class FlowOperator(Protocol):
    """Measures image motion between pairs of images, in both directions at once."""

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> Any:
        """Encode an image for matching; computed once per frame."""
        ...

    def texture(self, encoded: Any) -> float:
        """Return the fraction of the grid on which the image has enough texture to be matched."""
        ...

    def grey(self, encoded: Any) -> Float[Tensor, "h w"]:
        """Return the image in grey levels, 0 to 255, on the device of the grid."""
        ...

    def measure(
        self,
        first: Sequence[Any],
        second: Sequence[Any],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        """Match ``first[e]`` with ``second[e]``; returns first -> second and second -> first.

        ``forward`` and ``backward`` are initial estimates of the matched positions in pixels (the
        reprojection, right to a few pixels); None for a cold start. ``fine`` False allows a
        cheaper, less precise measurement. ``memory`` was returned by earlier measurements of these
        pairs; operators without a memory ignore it.
        """
        ...
