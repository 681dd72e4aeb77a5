"""Adaptive density control: disks with large image gradients are doubled or split.

The rules of 3D Gaussian splatting (Kerbl et al. 2023, Sec. 5.2) on the image gradients of 2DGS.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.lie import quaternion_to_matrix
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import AppearanceDisks


class GradientStatistics:
    """Mean image gradient of each disk since the last refinement."""

    def __init__(self, count: int, device: torch.device) -> None:
        self._sum = torch.zeros(count, device=device)
        self._views = torch.zeros(count, device=device)

    def add(
        self,
        gradient: Float[Tensor, "n 2"],
        visible: Bool[Tensor, "n"],
        width: int,
        height: int,
    ) -> None:
        """Add one image's gradient, given per pixel; it is counted in half image sizes."""
        norm = torch.hypot(gradient[:, 0] * (width / 2), gradient[:, 1] * (height / 2))
        self._sum += torch.where(visible, norm, 0.0)
        self._views += visible

    def mean(self) -> Float[Tensor, "n"]:
        """Mean norm over the images that showed the disk; 0 for disks that none showed."""
        return self._sum / self._views.clamp(min=1)


def refine(
    disks: AppearanceDisks,
    gradient: Float[Tensor, "n"],
    step: float,
    scene_scale: float,
    config: AppearanceConfig,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "k"], AppearanceDisks]:
    """Double small disks and split large ones where gradients are high; remove useless ones.

    Returns the rows that stay unchanged, and the new disks.
    """
    disks = disks.map(lambda tensor: tensor.detach())
    is_steep = gradient > config.grow_gradient
    small = disks.scales.amax(1) <= config.grow_scale * scene_scale
    split = is_steep & ~small
    doubles = disks.map(lambda tensor: tensor[is_steep & small])
    halves = split_disks(disks.map(lambda tensor: tensor[split]), config.split_shrink, generator)
    added = doubles.joined(halves)
    kept = torch.nonzero(~split & ~_useless(disks, step, scene_scale, config))[:, 0]
    useful = ~_useless(added, step, scene_scale, config)
    return kept, added.map(lambda tensor: tensor[useful])


def split_disks(
    disks: AppearanceDisks, shrink: float, generator: torch.Generator
) -> AppearanceDisks:
    """Two smaller disks for each, at points drawn from it, in its plane."""
    tangents = quaternion_to_matrix(torch.nn.functional.normalize(disks.quaternions, dim=-1))
    both = disks.map(lambda tensor: torch.cat([tensor, tensor]))
    drawn = torch.randn(both.log_scales.shape, generator=generator, device=disks.means.device)
    offset = torch.einsum("nij,nj->ni", tangents[..., :2].repeat(2, 1, 1), drawn * both.scales)
    smaller = both.log_scales - math.log(shrink)
    return replace(both, means=both.means + offset, log_scales=smaller)


def _useless(
    disks: AppearanceDisks, step: float, scene_scale: float, config: AppearanceConfig
) -> Bool[Tensor, "n"]:
    """Mask of the disks that are too transparent or, at this step, too large."""
    clear = disks.opacities < config.prune_opacity
    if step <= config.prune_scale_start:
        return clear
    return clear | (disks.scales.amax(1) > config.prune_scale * scene_scale)
