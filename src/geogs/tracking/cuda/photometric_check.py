"""Photometric check of a pose on the GPU, in a few launches."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.world.grid import STRIDE, SampleGrid

SOURCE = Path(__file__).with_name("photometric_check.cu")
WINDOWS = 8
"""Windows per block of threads."""


def median_correlation(
    grid: SampleGrid,
    first: Float[Tensor, "h w"],
    second: Float[Tensor, "h w"],
    step: int,
    least_variance: float,
    T_ji: Float[Tensor, "4 4"] | None = None,
    inverse_depth: Float[Tensor, "p"] | None = None,
    information: Float[Tensor, "p"] | None = None,
    pixels: Float[Tensor, "p 2"] | None = None,
) -> Float[Tensor, "2"]:
    """Return the median correlation of the windows around every ``step``-th cell, and their number.

    Cells are projected by the relative pose ``T_ji`` (float64) and their depth or, without it, lie
    at ``pixels``. Cells without information do not count, nor do windows whose smoothed variance in
    the first image is at most ``least_variance``. The result is float64 and stays on the GPU.
    """
    c = grid.camera
    device = first.device
    count = -(-grid.size // step)
    keys = torch.empty(count, dtype=torch.int32, device=device)
    found = torch.empty(2, dtype=torch.float64, device=device)
    where = (T_ji, inverse_depth, information, pixels)
    kernels = kernels_for(SOURCE, device)
    kernels["correlate_windows"](
        -(-count // WINDOWS), (32, WINDOWS), first.contiguous(), second.contiguous(), c.width,
        c.height, grid.rays, grid.width, STRIDE, step, count,
        *(None if x is None else x.contiguous() for x in where),
        *c.numbers, least_variance, keys,
    )  # fmt: skip
    kernels["median_correlation"](1, 256, keys, count, found)
    return found


def matched_motion(
    grid: SampleGrid, pixels: Float[Tensor, "p 2"], weight: Float[Tensor, "p 2"]
) -> Float[Tensor, "2"]:
    """Run :func:`~geogs.tracking.matching.photometric_check.matched_motion` on the GPU; float64."""
    keys = torch.empty(grid.size, dtype=torch.int32, device=pixels.device)
    found = torch.empty(2, dtype=torch.float64, device=pixels.device)
    kernels_for(SOURCE, pixels.device)["matched_motion"](
        1, 512, pixels.contiguous(), weight.contiguous(), grid.pixels, grid.size, keys, found
    )
    return found
