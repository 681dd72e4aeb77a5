"""Fields on the sample grid on the GPU: filling holes, carrying depth from view to view."""

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.keyframes.grid import OFFSET, STRIDE, SampleGrid

SOURCE = Path(__file__).with_name("fields.cu")


def _threads(grid: SampleGrid) -> int:
    return max(64, min(-(-grid.size // 32) * 32, 1024))


def _pyramid_size(grid: SampleGrid) -> int:
    """Floats of the coarser levels of one field and its confidence."""
    width, height, total = grid.width, grid.height, 0
    while min(width, height) > 2:
        width, height = -(-width // 2), -(-height // 2)
        total += 2 * width * height
    return total


def fill_fields(
    grid: SampleGrid, values: Float[Tensor, "n p"], confidence: Float[Tensor, "n p"]
) -> Float[Tensor, "n p"]:
    """``SampleGrid.fill`` of several fields in one launch."""
    values, confidence = values.contiguous(), confidence.contiguous()
    out, size = torch.empty_like(values), _pyramid_size(grid)
    scratch = values.new_empty(len(values) * size)
    kernel = kernels_for(SOURCE, values.device)["fill_fields"]
    kernel(
        len(values), _threads(grid), values, confidence, grid.width, grid.height, size, scratch, out
    )
    return out


def carry_depth(
    grid: SampleGrid,
    T: Float[Tensor, "n 4 4"],
    T_source: Float[Tensor, "m 4 4"],
    source: Int[Tensor, "n"],
    inverse_depth: Float[Tensor, "m p"],
    information: Float[Tensor, "m p"],
    reproject: bool,
) -> tuple[Tensor, ...]:
    """Depth of sources as seen from views at T (world to camera), which have none of their own.

    Returns inverse depth (n, p) and information (n, p) in the views, or, with ``reproject``, the
    pixels (n, p, 2) of the sources' cells in the views and of the views' cells in the sources.
    """
    device, camera, n = inverse_depth.device, grid.camera, len(T)
    poses = to_device(torch.cat([T, T_source]), device)
    rows = to_device(source, device, torch.int32)
    size = 2 * grid.size + _pyramid_size(grid)
    memory = inverse_depth.new_empty(n * (size + grid.size))
    scratch, depth = memory[: n * size], memory[n * size :]
    shape = (2, n, grid.size, 2) if reproject else (n, grid.size)
    out = inverse_depth.new_empty(shape)
    there, back = out.unbind() if reproject else (None, None)
    kernels_for(SOURCE, device)["carry_depth"](
        n, _threads(grid), poses[:n], poses[n:], rows, inverse_depth, information, grid.rays,
        grid.width, grid.height, OFFSET, STRIDE, camera.fx, camera.fy, camera.cx, camera.cy, size,
        scratch, depth, None if reproject else out, there, back,
    )  # fmt: skip
    return tuple(out.unbind()) if reproject else (depth.reshape(n, -1), out)
