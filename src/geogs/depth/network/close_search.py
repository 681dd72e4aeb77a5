"""The second search: a few depths in every cell at 1/2, near those of the planes at 1/4.

At an edge a coarse cell shows two surfaces. So the depths on either side and the second mode of the
planes are tried beside the cell's own, and one of them is chosen, not their mean.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from geogs.depth.network.plane_views import TriedDepths

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
_PIXELS = 2


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
    own, wide = at_half.detach(), step[:, None, None]
    first = modes.first.detach()[:, None]
    nearest = -functional.max_pool2d(-first, 3, 1, 1)[:, 0]
    farthest = functional.max_pool2d(first, 3, 1, 1)[:, 0]
    others = [_twice(x) for x in (nearest, farthest, modes.second.detach())]
    tried = torch.stack([own + c * wide for c in CLOSE] + others, 1)
    aside = [((x - own) / wide).clamp(-_FAR_ASIDE, _FAR_ASIDE) for x in others]
    about = torch.stack([*aside, _twice(modes.probability)], 1)
    label = torch.cat([step.new_full((len(step), 1), c) for c in (*CLOSE, 0.0, 0.0, 0.0)], 1)
    spacing = (CLOSE[1] - CLOSE[0]) * step
    return TriedDepths(tried.flatten(2), label, spacing, _PIXELS), about


def chosen(
    logits: Float[Tensor, "b d h w"],
    log_depth: Float[Tensor, "b d h w"],
    step: Float[Tensor, "b"],
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
