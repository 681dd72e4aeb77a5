"""From plane scores to depth, its deviation, and normals."""

import itertools
import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from geogs.depth.network.layers import Block, Residual, doubled, upsampled
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import cell_rays
from geogs.depth.network.stereo_views import DepthPrediction
from geogs.depth.network.surface_normals import normals_of

MOST_RESIDUAL = 2.0
"""Steps between planes by which a depth may be moved away from what the planes say."""
LEAST_LOG_SCALE, MOST_LOG_SCALE = -6.5, 0.0
"""Bounds of the logarithm of the Laplace scale of log depth."""
MOST_CONCENTRATION = 500.0
_LIKELY = -3.0
"""Logit of the fraction of outliers that an untrained network expects."""


class VolumeNetwork(nn.Module):
    """A U-Net over plane scores, the channels, that joins the context at every scale."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        widths, context = options.volume, options.context[1:]
        inputs, down, steps = options.planes + 1, [], []
        for level, (width, beside) in enumerate(zip(widths, context, strict=True)):
            if level:
                steps.append(Block(inputs, width, 4))
                inputs = width
            down.append(nn.Sequential(Block(inputs + beside, width), Residual(width)))
            inputs = width
        self.down, self.steps = nn.ModuleList(down), nn.ModuleList(steps)
        pairs = list(itertools.pairwise(widths))
        self.lateral = nn.ModuleList(nn.Conv2d(deep, wide, 1) for wide, deep in pairs)
        self.up = nn.ModuleList(Residual(wide) for wide, _ in pairs)

    def forward(
        self, volume: Float[Tensor, "b d1 h w"], context: list[Tensor]
    ) -> Float[Tensor, "b c h w"]:
        x, kept = volume, []
        for level, (block, beside) in enumerate(zip(self.down, context, strict=True)):
            x = self.steps[level - 1](x) if level else x
            x = block(torch.cat([x, beside], 1))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](kept[level] + doubled(self.lateral[level](x)))
        return x


class DepthReadout(nn.Module):
    """Reads the result off the features of the volume at 1/4 and the context at 1/2."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        deep, wide = options.volume[0], options.decoder
        self.planes = nn.Sequential(Block(deep, deep), nn.Conv2d(deep, options.planes, 1))
        self.to_half = nn.Sequential(Block(deep, deep), nn.Conv2d(deep, 36, 1))
        self.join = nn.Sequential(Block(deep + options.context[0] + 2, wide), Residual(wide))
        self.depth = nn.Sequential(Block(wide, wide), nn.Conv2d(wide, 3, 1))
        self.normal = nn.Sequential(Block(wide + 5, wide), nn.Conv2d(wide, 4, 1))
        self.to_full = nn.Sequential(Block(wide, wide), nn.Conv2d(wide, 36, 1))
        for head in (self.depth, self.normal):
            for parameter in head[-1].parameters():  # at first, what the planes say
                nn.init.normal_(parameter, std=1e-3)

    def forward(
        self,
        features: Float[Tensor, "b c h4 w4"],
        context: Float[Tensor, "b x h2 w2"],
        log_planes: Float[Tensor, "b d"],
        intrinsics: Float[Tensor, "b 4"],
        scores: Float[Tensor, "b d h4 w4"],
    ) -> DepthPrediction:
        device = features.device.type
        logits = self.planes(features).float()
        with torch.autocast(device, enabled=False):
            at_quarter = expected(logits, log_planes)
        to_half = self.to_half(features)
        with torch.autocast(device, enabled=False):
            coarse = upsampled(at_quarter[:, None], to_half)
        height, width = coarse.shape[-2:]
        rays = cell_rays(intrinsics, height, width, 2).unflatten(2, (height, width))
        local = coarse - functional.avg_pool2d(coarse, 5, 1, 2, count_include_pad=False)
        joined = torch.cat([doubled(features), context, coarse, 10 * local], 1)
        x = self.join(joined)
        raw = self.depth(x).float()
        step = torch.diff(log_planes, dim=1).mean(1)[:, None, None, None]
        at_half = coarse + MOST_RESIDUAL * step * raw[:, :1].tanh()
        with torch.autocast(device, enabled=False):
            bent = normals_of(at_half[:, 0].detach(), rays)
        tilt = self.normal(torch.cat([x, bent, rays[:, :2]], 1)).float()
        to_full = self.to_full(x)
        with torch.autocast(device, enabled=False):
            normal = facing(tilt[:, :3] + bent, rays)
            numbers = torch.cat([at_half, raw[:, 1:], normal, tilt[:, 3:]], 1)
            fine = upsampled(numbers, to_full)
            own = cell_rays(intrinsics, 2 * height, 2 * width, 1).unflatten(2, (2 * height, -1))
            return DepthPrediction(
                log_depth=fine[:, 0],
                log_scale=bounded(fine[:, 1]),
                outlier=fine[:, 2] + _LIKELY,
                normal=facing(fine[:, 3:6], own),
                concentration=concentration(fine[:, 6]),
                at_half=at_half[:, 0],
                at_quarter=at_quarter,
                plane_logits=logits,
                plane_scores=scores,
                log_planes=log_planes,
            )


def expected(
    logits: Float[Tensor, "b d h w"], log_planes: Float[Tensor, "b d"]
) -> Float[Tensor, "b h w"]:
    """Mean logarithm of depth of the distribution over the planes."""
    return (logits.softmax(1) * log_planes[:, :, None, None]).sum(1)


def bounded(raw: Tensor) -> Tensor:
    """Logarithms of Laplace scales: 3 % for a raw 0, smoothly bounded."""
    middle, half = (MOST_LOG_SCALE + LEAST_LOG_SCALE) / 2, (MOST_LOG_SCALE - LEAST_LOG_SCALE) / 2
    return middle + half * (raw / half + math.atanh((math.log(0.03) - middle) / half)).tanh()


def concentration(raw: Tensor) -> Tensor:
    """Positive, 2 for a raw 0, growing like an exponential that is bent to its bound."""
    return (MOST_CONCENTRATION / (1 + (MOST_CONCENTRATION / 2 - 1) * (-raw).exp())).clamp_min(1e-2)


def facing(
    vector: Float[Tensor, "b 3 h w"], rays: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Unit vectors; what points away from the camera is laid down across its ray (after DSINE)."""
    ray = functional.normalize(rays, dim=1)
    away = (vector * ray).sum(1, keepdim=True)
    bent = vector - (away + 0.02).clamp_min(0) * ray
    return bent * (bent.square().sum(1, keepdim=True) + 1e-8).rsqrt()
