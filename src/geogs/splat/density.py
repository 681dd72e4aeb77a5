"""Where the map needs disks, and which disks it can do without."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.config import DiskConfig
from geogs.splat.map import GaussianMap
from geogs.splat.render import RenderOutput


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


def unexplained(
    render: RenderOutput,
    depth: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"],
    config: DiskConfig,
) -> Bool[Tensor, "h w"]:
    """Pixels whose known depth the map does not show: too transparent, or behind a sure depth.

    A map in front of the depth is no reason for a disk: it would be hidden, and made again from
    every keyframe. What stands in front wrongly is carved instead.
    """
    empty = render.alpha < config.insert_alpha
    behind = render.depth - depth > config.insert_behind * depth
    return (depth > 0) & (empty | (behind & (confidence > 0.5)))


def worth_keeping(disks: GaussianMap, config: DiskConfig) -> Bool[Tensor, "n"]:
    """Disks that are finite and not transparent."""
    finite = torch.stack([torch.isfinite(p).flatten(1).all(1) if p.ndim > 1 else torch.isfinite(p)
                          for p in disks.parameters]).all(0)  # fmt: skip
    return finite & (disks.opacity > config.prune_opacity)
