"""Encoders of single images: features to match, and the keyframe's context."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from geogs.depth.network.layers import Block, Residual, doubled
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import cell_rays


class MatchingEncoder(nn.Module):
    """Matching features of unit scale at 1/4 and 1/2, the same network for all views."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        half, quarter, eighth = options.encoder
        self.at_half = nn.Sequential(Block(3, half, 6), Residual(half))
        self.at_quarter = nn.Sequential(
            Block(half, quarter, 4), Residual(quarter), Residual(quarter)
        )
        self.at_eighth = nn.Sequential(Block(quarter, eighth, 4), Residual(eighth))
        self.back = nn.Conv2d(eighth, quarter, 1)
        self.out = nn.Sequential(Block(quarter, quarter), nn.Conv2d(quarter, options.matching, 1))
        self.back_to_half = nn.Conv2d(quarter, half, 1)
        self.fine = nn.Sequential(Block(half, half), nn.Conv2d(half, options.fine_matching, 1))

    def forward(
        self, images: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n c h4 w4"], Float[Tensor, "n f h2 w2"]]:
        half = self.at_half(images)
        quarter = self.at_quarter(half)
        joined = quarter + doubled(self.back(self.at_eighth(quarter)))
        fine = self.fine(half + doubled(self.back_to_half(joined)))
        return _of_one_length(self.out(joined)), _of_one_length(fine)


class ContextEncoder(nn.Module):
    """Features of the keyframe and its rays at 1/2, 1/4, ..."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        inputs, stages = 5, []
        for level, channels in enumerate(options.context):
            down = Block(inputs, channels, 4 if level else 6)
            stages.append(nn.Sequential(down, Residual(channels)))
            inputs = channels
        self.stages = nn.ModuleList(stages)

    def forward(
        self, images: Float[Tensor, "n 3 h w"], intrinsics: Float[Tensor, "n 4"]
    ) -> list[Tensor]:
        height, width = images.shape[-2:]
        rays = cell_rays(intrinsics, height, width, 1)[:, :2].unflatten(2, (height, width))
        x, found = torch.cat([images, rays], 1), []
        for stage in self.stages:
            x = stage(x)
            found.append(x)
        return found


def normalised(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Images minus the mean of each colour, divided by the contrast of all."""
    centred = images - images.mean((2, 3), keepdim=True)
    return centred / (centred.square().mean((1, 2, 3), keepdim=True).sqrt() + 0.02)


def _of_one_length(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    return features.shape[1] ** 0.5 * functional.normalize(features.float(), dim=1)
