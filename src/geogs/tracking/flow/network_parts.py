"""Parts that the flow networks share."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from geogs.world.grid import OFFSET, STRIDE


def two_convolutions(
    inputs: int, middle: int, outputs: int, first: int, second: int, *after: nn.Module
) -> nn.Sequential:
    """Return two convolutions with a ReLU between them, and what comes ``after``.

    ``first`` and ``second`` are the edges of their kernels.
    """
    return nn.Sequential(
        nn.Conv2d(inputs, middle, first, padding=first // 2),
        nn.ReLU(),
        nn.Conv2d(middle, outputs, second, padding=second // 2),
        *after,
    )


def cell_positions(height: int, width: int, like: Tensor) -> Float[Tensor, "h w 2"]:
    """Return x, y of every cell, in cells."""
    rows, columns = (
        torch.arange(count, dtype=like.dtype, device=like.device) for count in (height, width)
    )
    return torch.cartesian_prod(rows, columns).flip(1).reshape(height, width, 2)


def cell_pixels(height: int, width: int, like: Tensor) -> Float[Tensor, "p 2"]:
    """Return the pixels of the sample grid's cells, row by row."""
    return (OFFSET + STRIDE * cell_positions(height, width, like)).flatten(0, 1)
