"""Selection of pixels that need disks, and of disks that can be removed."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.splat.render import RenderOutput
from geogs.world.disks import GaussianMap

INSERT_ALPHA = 0.4
"""A pixel gets a disk where the map's alpha is below this: most of the light passes ..."""
INSERT_BEHIND = 0.05
"""... or where the map lies this fraction of the depth behind a confident depth."""
PRUNE_OPACITY = 0.05
"""Disks below this opacity are removed."""


def candidate_pixels(
    height: int, width: int, stride: int, generator: torch.Generator
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Rows and columns of one pixel in every stride x stride cell, jittered within the cell."""
    v, u = torch.meshgrid(
        torch.arange(stride // 2, height, stride),
        torch.arange(stride // 2, width, stride),
        indexing="ij",
    )
    reach = (stride - 1) // 2
    jitter = torch.randint(-reach, reach + 1, (2, *v.shape), generator=generator)
    v = (v + jitter[0]).clamp(0, height - 1)
    u = (u + jitter[1]).clamp(0, width - 1)
    return v.flatten(), u.flatten()


def spread_candidates(
    needed: Bool[Tensor, "h w"],
    at_edge: Bool[Tensor, "h w"],
    stride: int,
    edge_stride: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Rows and columns of some needed pixels, and the spacing of each.

    It is ``stride``, at depth edges ``edge_stride`` if that is less: a disk is about as large as
    its spacing, and a large one would overhang the edge.
    """
    found = []
    height, width = needed.shape
    for step, there in (
        (stride, needed & ~at_edge), (min(stride, edge_stride), needed & at_edge),
    ):  # fmt: skip
        v, u = (x.to(needed.device) for x in candidate_pixels(height, width, step, generator))
        chosen = there[v, u]
        v, u = v[chosen], u[chosen]
        found.append((v, u, torch.full_like(v, step)))
    v, u, spacing = (torch.cat(parts) for parts in zip(*found, strict=True))
    return v, u, spacing


def unexplained(
    render: RenderOutput,
    depth: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"],
) -> Bool[Tensor, "h w"]:
    """Pixels with a depth where the map is transparent or behind a confident depth.

    Where the map is in front of the depth, a disk would be hidden, and made again from every
    keyframe; wrong disks in front are carved instead.
    """
    empty = render.alpha < INSERT_ALPHA
    behind = render.depth - depth > INSERT_BEHIND * depth
    return (depth > 0) & (empty | (behind & (confidence > 0.5)))


def worth_keeping(disks: GaussianMap) -> Bool[Tensor, "n"]:
    """Disks that are finite and not transparent."""
    finite = torch.stack([torch.isfinite(p).flatten(1).all(1) if p.ndim > 1 else torch.isfinite(p)
                          for p in disks.parameters]).all(0)  # fmt: skip
    return finite & (disks.opacity > PRUNE_OPACITY)
