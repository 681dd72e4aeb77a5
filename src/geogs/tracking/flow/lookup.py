"""Correlation windows around estimated positions of cells, in two ways.

Our network has one descriptor for every cell of the first image; the second image has descriptors
on a pyramid of grids, some finer than the cells, so that a position can be estimated to a fraction
of a pixel. DROID-SLAM's reads a correlation volume (:class:`CorrelationVolume`).
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
VOLUME_LEVELS = 4
"""Levels of the pyramid of a correlation volume."""
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
    from geogs.tracking.flow.flow_kernels import lookup_windows

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
        ctx.sizes = sizes
        ctx.grid = grid
        ctx.types = (source.dtype, descriptors.dtype)
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


class CorrelationVolume:
    """All-pairs correlation of two feature maps, as in DROID-SLAM (after RAFT).

    It is computed once and read many times: 16 h^2 w^2 / 3 bytes a pair. All-pairs products of the
    features, averaged over 2 x 2, 4 x 4, ... pixels of the second map, are read in a square window
    around a position (Teed & Deng, "RAFT: Recurrent All-Pairs Field Transforms for Optical Flow",
    ECCV 2020, section 3.2).

    Conventions, which are those of the published networks:

    - products are divided by 16;
    - positions are in pixels of the feature maps, x before y, pixel centres at integers;
    - on level l of the pyramid they are divided by 2^l only (the network has to learn the
      half-pixel shift of the centres of averaged pixels);
    - beyond the border the correlation is zero;
    - the channels are ordered by level, then x offset, then y offset: channel
      ``(7 l + i) 7 + j`` is at (x + i - 3, y + j - 3).
    """

    def __init__(self, first: Float[Tensor, "b d h w"], second: Float[Tensor, "b d h w"]) -> None:
        """Multiply all pairs of features: those of the pixels that are looked up, and those of the
        images they are looked for in."""
        # Half of the factor on each side: products of half-precision features stay in range.
        a, b = (first / 4).flatten(2), (second / 4).flatten(2)
        self._levels = [(a.mT @ b).reshape(-1, 1, *second.shape[-2:])]
        for _ in range(VOLUME_LEVELS - 1):
            self._levels.append(_halved(self._levels[-1]))

    def __call__(self, coords: Float[Tensor, "b h w 2"]) -> Float[Tensor, "b c h w"]:
        windows = [
            _window(level.flatten(1), level.shape[-2:], coords / 2**k)
            for k, level in enumerate(self._levels)
        ]
        return torch.cat(windows, 1)


def _halved(image: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h2 w2"]:
    """Return means over 2 x 2 pixels; of size zero where there are none."""
    height, width = image.shape[-2:]
    if min(height, width) < 2:
        return image.new_zeros(*image.shape[:2], height // 2, width // 2)
    return functional.avg_pool2d(image, 2)


def _window(
    products: Float[Tensor, "n q"], size: torch.Size, coords: Float[Tensor, "b h w 2"]
) -> Float[Tensor, "b c h w"]:
    """Read a bilinear window of each row of products, an image of this size; zero outside.

    All positions of a window have the same fraction, so values at 8 x 8 whole pixels are enough.
    """
    height, width = size
    if not height or not width:
        return coords.new_zeros(len(coords), WINDOW, *coords.shape[1:3], dtype=torch.float32)
    # Far away (or NaN) is equivalent to just outside.
    limit = coords.new_tensor([width, height]) + RADIUS + 1
    near = coords.float().nan_to_num(-1e6).clamp(min=-RADIUS - 2.0).minimum(limit.float())
    corner = near.floor()
    fx, fy = ((near - corner)[..., None, None, k] for k in (0, 1))
    steps = torch.arange(-RADIUS, RADIUS + 2, device=coords.device)
    x, y = (corner[..., None, k].long() + steps for k in (0, 1))
    inside = ((x >= 0) & (x < width))[..., :, None] & ((y >= 0) & (y < height))[..., None, :]
    index = y.clamp(0, height - 1)[..., None, :] * width + x.clamp(0, width - 1)[..., :, None]
    values = products.gather(1, index.reshape(len(products), -1)).reshape(index.shape)
    values = torch.where(inside, values.float(), 0.0)
    values = values[..., :-1, :] * (1 - fx) + values[..., 1:, :] * fx
    values = values[..., :-1] * (1 - fy) + values[..., 1:] * fy
    return values.flatten(3).permute(0, 3, 1, 2)
