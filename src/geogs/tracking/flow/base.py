"""What the tracker asks of a flow operator."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor


@dataclass(frozen=True)
class FlowMatch:
    """Where the cells of one image lie in another."""

    pixels: Float[Tensor, "e p 2"]
    """Position in the second image of each grid cell of the first."""
    weight: Float[Tensor, "e p 2"]
    """Inverse variance of x and y in 1 / pixel^2; zero where there is no match."""
    damping: Float[Tensor, "e p"] | None = None
    """What resists a change of the first image's inverse depth, in the units of its inverse
    variance; equal for all edges of a call that share the first image. None for nothing."""
    memory: tuple[Any, ...] | None = field(default=None, metadata={"stored": False})
    """Of each edge, what the operator wants to be given when it measures that edge again."""

    def sure(self) -> Bool[Tensor, "e p"]:
        """Cells that a geometry may be guessed from: matched with no less than a hundredth of the
        weight of the edge's best, where a mere guess would count like a good match."""
        weight = self.weight[..., 0]
        best = torch.quantile(weight.float(), 0.98, dim=-1, keepdim=True)
        return (weight > 0) & (weight > 0.01 * best)


Memories = Sequence[tuple[Any, Any]]
"""Of each pair, what the operator returned as memory of the two directions; None for nothing."""


@runtime_checkable
class FlowOperator(Protocol):
    """Measures image motion between pairs of images, in both directions at once."""

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> Any:
        """Whatever the operator keeps of an image; computed once per frame."""
        ...

    def texture(self, encoded: Any) -> float:
        """Fraction of the grid on which the image has enough structure to be matched."""
        ...

    def grey(self, encoded: Any) -> Float[Tensor, "h w"]:
        """The image in grey levels, 0 to 255, on the device of the grid."""
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

        ``forward`` and ``backward`` are the present estimates of the matched positions in pixels
        (the reprojection, right to a few pixels); None means nothing is known (a cold start).
        ``fine`` False allows a cheaper, less precise measurement. ``memory`` is what earlier
        measurements of these pairs returned; operators without a memory ignore it.
        """
        ...
