"""Decoder from plane scores to depth, its deviation, and normals.

A second search tries a few depths in every cell at 1/2, near those of the planes at 1/4. At an edge
a coarse cell shows two surfaces. So the depths on either side and the second mode of the planes are
tried beside the cell's own, and one of them is chosen, not their mean.
"""

import itertools
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from geogs.depth.network.layers import Block, Residual, doubled, upsampled
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import TriedDepths, cell_rays, plane_step
from geogs.depth.network.stereo_views import DepthPrediction, StereoViews
from geogs.depth.network.surface_normals import normals_of
from geogs.depth.network.volume import PlaneVolume

MOST_RESIDUAL = 1.0
"""Largest residual on the chosen depth, steps between planes."""
SURFACE_GAP = 0.04
"""Relative difference above which depths are of two surfaces, and not averaged."""
_ABOUT = 5
"""Channels beside the scores of the depths tried at 1/2."""
LEAST_LOG_SCALE, MOST_LOG_SCALE = -6.5, 0.0
"""Bounds of the logarithm of the Laplace scale of log depth."""
MOST_CONCENTRATION = 500.0
CLOSE = (-0.6, -0.2, 0.2, 0.6)
"""Depths tried around the cell's own, in steps between planes."""
COUNT = len(CLOSE) + 3
"""``CLOSE``, the nearest and the farthest depth around, and the second mode of the planes."""
ONE_SURFACE = 1.0
"""Steps within which tried depths are of one surface."""
_MODE = 2
"""Planes to either side of the likeliest that belong to its mode."""
_FAR_ASIDE = 5.0
"""Bound of the distances that the network sees, steps."""


@dataclass(frozen=True)
class PlaneModes:
    """The two modes of each cell's planes at 1/4; logarithms of depth over the typical depth."""

    first: Float[Tensor, "b h w"]
    """Mean around the likeliest plane."""
    second: Float[Tensor, "b h w"]
    """Mean around the likeliest of the other planes."""
    probability: Float[Tensor, "b h w"]
    """Probability of the first mode."""


def plane_modes(logits: Float[Tensor, "b d h w"], log_planes: Float[Tensor, "b d"]) -> PlaneModes:
    """The two likeliest depths of a distribution over planes: a mean over all of them would lie
    between two surfaces."""
    p = logits.softmax(1)
    place = torch.arange(p.shape[1], device=p.device)[:, None, None]
    z = log_planes[:, :, None, None]
    likeliest = _peak(p)
    near = p * ((place - likeliest).abs() <= _MODE)
    probability = near.sum(1)
    first = (near * z).sum(1) / probability
    rest = p * ((place - likeliest).abs() > _MODE + 1)
    near = rest * ((place - _peak(rest)).abs() <= _MODE)
    total = near.sum(1)
    second = (near * z).sum(1) / total.clamp_min(1e-9)
    return PlaneModes(first, torch.where(total > 1e-9, second, first), probability)


def close_depths(
    modes: PlaneModes, at_half: Float[Tensor, "b h2 w2"], step: Float[Tensor, "b"]
) -> tuple[TriedDepths, Float[Tensor, "b 4 h2 w2"]]:
    """Depths to try at 1/2, and inputs of the network beside them: steps from ``at_half`` to the
    nearest, the farthest and the second depth, and the probability of the first.

    ``at_half`` is the cell's own depth; ``step`` that between planes. No gradient goes to either.
    """
    own = at_half.detach()
    wide = step[:, None, None]
    first = modes.first.detach()[:, None]
    nearest = -functional.max_pool2d(-first, 3, 1, 1)[:, 0]
    farthest = functional.max_pool2d(first, 3, 1, 1)[:, 0]
    others = [_twice(x) for x in (nearest, farthest, modes.second.detach())]
    tried = torch.stack([own + c * wide for c in CLOSE] + others, 1)
    aside = [((x - own) / wide).clamp(-_FAR_ASIDE, _FAR_ASIDE) for x in others]
    about = torch.stack([*aside, _twice(modes.probability)], 1)
    label = torch.cat([step.new_full((len(step), 1), c) for c in (*CLOSE, 0.0, 0.0, 0.0)], 1)
    spacing = (CLOSE[1] - CLOSE[0]) * step
    return TriedDepths(tried.flatten(2), label, spacing, cell=2), about


def chosen(
    logits: Float[Tensor, "b d h w"], log_depth: Float[Tensor, "b d h w"], step: Float[Tensor, "b"]
) -> Float[Tensor, "b h w"]:
    """Softmax mean of the depths that are of the same surface as the likeliest."""
    best = log_depth.gather(1, logits.argmax(1, keepdim=True))
    beside = (log_depth - best).abs() <= ONE_SURFACE * step[:, None, None, None]
    weight = logits.softmax(1) * beside
    return (weight * log_depth).sum(1) / weight.sum(1)


def _peak(p: Float[Tensor, "b d h w"]) -> Tensor:
    """Index of the plane whose sum with its two neighbours is largest."""
    return functional.avg_pool3d(p[:, None], (3, 1, 1), 1, (1, 0, 0)).argmax(2)


def _twice(x: Float[Tensor, "b h w"]) -> Float[Tensor, "b h2 w2"]:
    """Repeat every cell 2 x 2 times."""
    return x.repeat_interleave(2, 1).repeat_interleave(2, 2)


class VolumeNetwork(nn.Module):
    """A U-Net with the plane scores as channels and the context at every scale."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        widths = options.volume
        context = options.context[1:]
        inputs = options.planes + 1
        down = []
        steps = []
        for level, (width, beside) in enumerate(zip(widths, context, strict=True)):
            if level:
                steps.append(Block(inputs, width, 4))
                inputs = width
            down.append(nn.Sequential(Block(inputs + beside, width), Residual(width)))
            inputs = width
        self.down = nn.ModuleList(down)
        self.steps = nn.ModuleList(steps)
        pairs = list(itertools.pairwise(widths))
        self.lateral = nn.ModuleList(nn.Conv2d(deep, wide, 1) for wide, deep in pairs)
        self.up = nn.ModuleList(Residual(wide) for wide, _ in pairs)

    def forward(
        self, volume: Float[Tensor, "b d1 h w"], context: list[Tensor]
    ) -> Float[Tensor, "b c h w"]:
        x = volume
        kept = []
        for level, (block, beside) in enumerate(zip(self.down, context, strict=True)):
            x = self.steps[level - 1](x) if level else x
            x = block(torch.cat([x, beside], 1))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](kept[level] + doubled(self.lateral[level](x)))
        return x


class DepthReadout(nn.Module):
    """Heads on the volume's features at 1/4 and the context at 1/2, with a second search there."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        deep = options.volume[0]
        wide = options.decoder
        self.planes = nn.Sequential(Block(deep, deep), nn.Conv2d(deep, options.planes, 1))
        self.to_half = nn.Sequential(Block(deep, deep), nn.Conv2d(deep, 36, 1))
        fine = replace(options, groups=options.fine_groups, matching=options.fine_matching)
        self.close = PlaneVolume(fine)
        beside = options.context[0] + 2 + COUNT + _ABOUT
        self.join = nn.Sequential(Block(deep + beside, wide), Residual(wide))
        self.choice = nn.Sequential(Block(wide, wide), nn.Conv2d(wide, COUNT, 1))
        self.depth = nn.Sequential(Block(wide, wide), nn.Conv2d(wide, 3, 1))
        self.normal = nn.Sequential(Block(wide + 5, wide), nn.Conv2d(wide, 4, 1))
        self.to_full = nn.Sequential(Block(wide, wide), nn.Conv2d(wide, 36, 1))
        for head in (self.depth, self.normal):
            for parameter in head[-1].parameters():  # at first, no change of the choice
                nn.init.normal_(parameter, std=1e-3)

    def forward(
        self,
        features: Float[Tensor, "b c h4 w4"],
        context: Float[Tensor, "b x h2 w2"],
        fine: Float[Tensor, "b v f h2 w2"],
        log_planes: Float[Tensor, "b d"],
        views: StereoViews,
        scores: Float[Tensor, "b d h4 w4"],
    ) -> DepthPrediction:
        """``fine`` are the matching features at 1/2, the keyframe's first."""
        with torch.autocast(features.device.type, enabled=False):
            step = plane_step(log_planes)
        logits = self.planes(features).float()
        to_half = self.to_half(features)
        with torch.autocast(features.device.type, enabled=False):
            modes = plane_modes(logits, log_planes)
            coarse = upsampled(modes.first[:, None], to_half, SURFACE_GAP)
            tried, about = close_depths(modes, coarse[:, 0], step)
            found = self.close(fine[:, 0], fine[:, 1:], views, tried)
        local = coarse - functional.avg_pool2d(coarse, 5, 1, 2, count_include_pad=False)
        x = self.join(torch.cat([doubled(features), context, coarse, 10 * local, found, about], 1))
        choice = found[:, :COUNT] + self.choice(x).float()
        raw = self.depth(x).float()
        with torch.autocast(features.device.type, enabled=False):
            depths = tried.log_depth.unflatten(2, coarse.shape[-2:])
            # The tried depths have no gradient; the coarse depth that they lie around gets it here.
            depths = depths + (coarse - coarse.detach())
            aside = MOST_RESIDUAL * step[:, None, None] * raw[:, 0].tanh()
            at_half = chosen(choice, depths, step) + aside
        fine = self._at_full(x, at_half, raw[:, 1:], views.intrinsics)
        height, width = fine.shape[-2:]
        with torch.autocast(features.device.type, enabled=False):
            own = cell_rays(views.intrinsics, height, width, 1).unflatten(2, (height, width))
            normal = facing(fine[:, 3:6], own)
        return DepthPrediction(
            log_depth=fine[:, 0],
            log_scale=bounded(fine[:, 1]),
            outlier=fine[:, 2] - 3.0,  # so that an untrained network expects few
            normal=normal,
            concentration=concentration(fine[:, 6]),
            at_half=at_half,
            at_quarter=modes.first,
            tried=depths,
            tried_logits=choice,
            plane_logits=logits,
            plane_scores=scores,
            log_planes=log_planes,
        )

    def _at_full(
        self,
        x: Float[Tensor, "b c h2 w2"],
        at_half: Float[Tensor, "b h2 w2"],
        raw: Float[Tensor, "b 2 h2 w2"],
        intrinsics: Float[Tensor, "b 4"],
    ) -> Float[Tensor, "b 7 h w"]:
        """Log depth, raw scale and outlier logit, normal and its raw concentration at full size."""
        height, width = at_half.shape[-2:]
        rays = cell_rays(intrinsics, height, width, 2).unflatten(2, (height, width))
        with torch.autocast(x.device.type, enabled=False):
            bent = normals_of(at_half.detach(), rays)
        tilt = self.normal(torch.cat([x, bent, rays[:, :2]], 1)).float()
        to_full = self.to_full(x)
        with torch.autocast(x.device.type, enabled=False):
            normal = facing(tilt[:, :3] + bent, rays)
            numbers = torch.cat([at_half[:, None], raw, normal, tilt[:, 3:]], 1)
            return upsampled(numbers, to_full, SURFACE_GAP)


def bounded(raw: Tensor) -> Tensor:
    """Logarithms of Laplace scales: 3 % for a raw 0, smoothly bounded."""
    middle = (MOST_LOG_SCALE + LEAST_LOG_SCALE) / 2
    half = (MOST_LOG_SCALE - LEAST_LOG_SCALE) / 2
    return middle + half * (raw / half + math.atanh((math.log(0.03) - middle) / half)).tanh()


def concentration(raw: Tensor) -> Tensor:
    """Positive concentration, logistic in ``raw``: 2 for 0, bounded by ``MOST_CONCENTRATION``."""
    return (MOST_CONCENTRATION / (1 + (MOST_CONCENTRATION / 2 - 1) * (-raw).exp())).clamp_min(1e-2)


def facing(
    vector: Float[Tensor, "b 3 h w"], rays: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Unit vectors; those that face away lose their part along the ray first (after DSINE)."""
    ray = functional.normalize(rays, dim=1)
    away = (vector * ray).sum(1, keepdim=True)
    bent = vector - (away + 0.02).clamp_min(0) * ray
    return bent * (bent.square().sum(1, keepdim=True) + 1e-8).rsqrt()
