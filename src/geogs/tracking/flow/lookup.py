"""Correlation windows around estimated positions of cells, without a correlation volume.

Every cell of the first image has one descriptor; the second image has descriptors on a pyramid of
grids, some finer than the cells, so that a position can be estimated to a fraction of a pixel.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from geogs.gpu.kernels import kernels_for
from geogs.threads import thread_map

SOURCE = Path(__file__).parents[1] / "cuda" / "flow_lookup.cu"
RADIUS = 3
"""Radius of a window, in descriptors."""
WINDOW = (2 * RADIUS + 1) ** 2
"""Number of values of a window, row by row."""
CHANNELS = 64
"""Channels of a descriptor; in the GPU's kernel each lane of a warp has two."""
_WARPS = 8


@dataclass(frozen=True)
class PyramidLevel:
    """A grid of descriptors: column u is at pixel ``(u - shift) / scale``."""

    width: int
    height: int
    scale: float
    shift: float


@dataclass(frozen=True)
class DescriptorPyramid:
    """Descriptors of images at several levels, all levels of an image one after the other."""

    descriptors: Float[Tensor, "n q c"]
    levels: tuple[PyramidLevel, ...]


@dataclass(frozen=True)
class Edges:
    """Pairs of images: the first is looked up in the second."""

    first: Int[Tensor, "e"]
    """Indices, int32."""
    second: Int[Tensor, "e"]
    """Indices, int32."""


def correlation_windows(
    source: Float[Tensor, "n p c"],
    pyramid: DescriptorPyramid,
    edges: Edges,
    centres: Float[Tensor, "e p 2"],
) -> Float[Tensor, "e p k"]:
    """Compute dot products / sqrt(c) of each cell's descriptor with 7 x 7 ones at every level.

    ``centres`` are pixels of the second image; windows are read bilinearly, zero outside. Channel
    ``49 l + 7 (dv + 3) + du + 3``. Differentiable in both descriptors (not in the centres).
    """
    if source.is_cuda:
        return _CudaWindows.apply(source, pyramid.descriptors, pyramid, edges, centres)
    if torch.is_grad_enabled() and (source.requires_grad or pyramid.descriptors.requires_grad):
        return correlation_windows_reference(source, pyramid, edges, centres)
    return _compiled_windows(source, pyramid, edges, centres)


def correlation_windows_reference(
    source: Float[Tensor, "n p c"],
    pyramid: DescriptorPyramid,
    edges: Edges,
    centres: Float[Tensor, "e p 2"],
) -> Float[Tensor, "e p k"]:
    """Reference for :func:`correlation_windows`: sample the descriptors, multiply, sum."""
    d = torch.arange(-RADIUS, RADIUS + 1, dtype=centres.dtype, device=centres.device)
    dv, du = torch.meshgrid(d, d, indexing="ij")
    offsets = torch.stack([du, dv], -1).reshape(-1, 2)
    mine = source[edges.first.long()]
    out = []
    table, _ = level_tables(pyramid.levels)
    for (offset, width, height), level in zip(table.tolist(), pyramid.levels, strict=True):
        field = pyramid.descriptors[edges.second.long(), offset : offset + width * height]
        image = field.mT.reshape(len(field), -1, height, width)
        points = (centres * level.scale + level.shift)[:, :, None] + offsets
        # A single descriptor has no extent; any size but zero puts it in the middle.
        size = points.new_tensor([max(width - 1, 1), max(height - 1, 1)])
        window = functional.grid_sample(image, 2 * points / size - 1, align_corners=True)
        out.append(torch.einsum("epc,ecpk->epk", mine, window) / source.shape[-1] ** 0.5)
    return torch.cat(out, -1)


def _compiled_windows(
    source: Tensor, pyramid: DescriptorPyramid, edges: Edges, centres: Tensor
) -> Tensor:
    from geogs.tracking.flow.lookup_kernels import lookup_windows

    mine, theirs = (x.float().numpy() for x in (source, pyramid.descriptors))
    points = centres.float().contiguous().numpy()
    table, scales = level_tables(pyramid.levels)
    out = np.empty((*points.shape[:2], len(table), WINDOW), np.float32)
    norm = np.float32(source.shape[-1] ** -0.5)

    def work(e: int) -> None:
        i, j = int(edges.first[e]), int(edges.second[e])
        lookup_windows(mine[i], theirs[j], points[e], table, scales, norm, out[e])

    thread_map(work, range(len(points)))
    return torch.from_numpy(out).flatten(2)


class _CudaWindows(torch.autograd.Function):
    """Forward and backward passes by the kernels; descriptors are read as bfloat16."""

    @staticmethod
    def forward(
        ctx: Any,
        source: Tensor,
        descriptors: Tensor,
        pyramid: DescriptorPyramid,
        edges: Edges,
        centres: Tensor,
    ) -> Tensor:
        mine, theirs = (_pairs(x) for x in (source, descriptors))
        device = centres.device
        table, scales = _tables_on(device, pyramid.levels)
        points = centres.float().contiguous()
        count, cells = points.shape[:2]
        levels = len(pyramid.levels)
        out = points.new_empty(count, cells, levels * WINDOW)
        common = (mine, theirs, edges.first, edges.second, points, table, scales)
        sizes = (cells, theirs.shape[1], CHANNELS**-0.5)
        grid = (-(-cells // _WARPS), levels, count)
        kernels_for(SOURCE, device)["lookup_windows"](grid, (32, _WARPS), *common, out, *sizes)
        ctx.save_for_backward(*common)
        ctx.sizes, ctx.grid, ctx.types = sizes, grid, (source.dtype, descriptors.dtype)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        common = ctx.saved_tensors
        mine, theirs = common[:2]
        grads = [torch.zeros(*x.shape[:2], CHANNELS, device=x.device) for x in (mine, theirs)]
        kernels_for(SOURCE, mine.device)["lookup_gradients"](
            ctx.grid, (32, _WARPS), *common, grad.float().contiguous(), *grads, *ctx.sizes
        )
        own, other = (g.to(t) for g, t in zip(grads, ctx.types, strict=True))
        return own, other, None, None, None


def level_tables(
    levels: tuple[PyramidLevel, ...],
) -> tuple[Int[np.ndarray, "l 3"], Float[np.ndarray, "l 2"]]:
    """Return offset, width and height of each level, int32; its factor and shift, float32."""
    sizes = [level.width * level.height for level in levels]
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    rows = [(o, v.width, v.height) for o, v in zip(offsets, levels, strict=True)]
    scales = [(level.scale, level.shift) for level in levels]
    return np.array(rows, np.int32), np.array(scales, np.float32)


@lru_cache(maxsize=8)
def _tables_on(device: torch.device, levels: tuple[PyramidLevel, ...]) -> tuple[Tensor, Tensor]:
    """Return the level tables on a device, copied there once."""
    table, scales = (torch.from_numpy(part).to(device) for part in level_tables(levels))
    return table, scales


def _pairs(descriptors: Float[Tensor, "n q c"]) -> Int[Tensor, "n q c2"]:
    """Round descriptors to bfloat16, two in an int32."""
    return descriptors.detach().to(torch.bfloat16).contiguous().view(torch.int32)
