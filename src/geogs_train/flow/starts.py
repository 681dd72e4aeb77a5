"""Start positions like a tracker's: the true flow with errors from wrong poses and depths."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from geogs.geometry.lie import se3_exp


@dataclass(frozen=True)
class StartOptions:
    """Errors of the network's start positions."""

    smallest: float = 0.05
    """Least mean disturbance, which is drawn log-uniformly, pixels."""
    largest: float = 16.0
    cold: float = 0.15
    """Fraction of the edges that start from zero motion."""
    bleed: float = 0.6
    """Fraction of the edges whose depth is blurred over object boundaries."""
    far: float = 0.0
    """Fraction of the edges, besides the cold ones, with a disturbance between ``largest`` and
    ``farthest``."""
    farthest: float = 64.0


def disturbed_starts(
    truth: Float[Tensor, "b gh gw 2"],
    depth: Float[Tensor, "b gh gw"],
    rays: Float[Tensor, "b gh gw 3"],
    T_ji: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
    cells: Float[Tensor, "gh gw 2"],
    options: StartOptions,
    generator: torch.Generator,
    largest: Float[Tensor, "b"] | None = None,
) -> Float[Tensor, "b gh gw 2"]:
    """Positions in the second view with a wrong pose and wrong depths, scaled to a drawn amount.

    ``truth`` are the true positions in pixels, ``rays`` the cells' K^-1 (x, y, 1), ``T_ji`` takes
    points of the first view to the second. ``largest`` is each edge's largest mean disturbance,
    if it is not that of the options.
    """
    n = len(truth)
    device = truth.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(n, *shape, generator=generator, device=device)

    def normal(*shape: int) -> Tensor:
        return torch.randn(n, *shape, generator=generator, device=device)

    def column(x: Tensor) -> Tensor:
        return x.reshape(n, 1, 1)

    log = math.log(options.smallest)
    most = torch.full((n,), options.largest, device=device) if largest is None else largest
    amount = (log + (most.log() - log) * uniform()).exp()
    if options.far:
        beyond = (uniform() * math.log(options.farthest / options.largest)).exp()
        amount = torch.where(uniform() < options.far, options.largest * beyond, amount)
    inverse = 1 / depth.clamp(min=1e-2)
    middle = inverse.flatten(1).median(1).values
    # Depth: blurred over edges, scaled by a smooth field, in some regions by noise.
    size = (int(inverse.shape[1]), int(inverse.shape[2]))
    blurred = _blur(_blur(inverse))
    inverse = torch.where(column(uniform() < options.bleed), blurred, inverse)
    strength = amount / 16
    field = _smooth_field(normal(2, 3, 4), size)
    inverse = inverse * (0.6 * column(strength) * field[:, 0]).exp()
    patches = _smooth_field(normal(2, 6, 8), size)
    inverse = inverse * (1.5 * column(strength) * (patches[:, 0] - 1).clamp(min=0)).exp()
    # Pose: rotated by about the amount, moved by a fraction of the depth.
    focal = intrinsics[:, 0]
    rotation = normal(3) * (0.5 * amount / focal)[:, None]
    shift = normal(3) * (0.5 * amount / focal / middle.clamp(min=1e-3))[:, None]
    T = se3_exp(torch.cat([shift, rotation], -1)) @ T_ji
    R = T[:, None, None, :3, :3]
    t = T[:, None, None, :3, 3]
    y = (R @ rays[..., None])[..., 0] + inverse[..., None] * t
    z = y[..., 2:].clamp(min=0.05)
    f = intrinsics[:, None, None, :2]
    c = intrinsics[:, None, None, 2:]
    start = y[..., :2] / z * f + c
    error = (start - truth).clamp(-200, 200).nan_to_num(0)
    mean = error.norm(dim=-1).flatten(1).median(1).values
    factor = (amount / mean.clamp(min=1e-3)).clamp(max=1.0)
    start = truth + factor.reshape(n, 1, 1, 1) * error
    return torch.where(column(uniform() < options.cold)[..., None], cells.expand_as(start), start)


def _smooth_field(
    coarse: Float[Tensor, "n c h w"], size: tuple[int, int]
) -> Float[Tensor, "n c gh gw"]:
    return functional.interpolate(coarse, size=size, mode="bicubic", align_corners=True)


def _blur(x: Float[Tensor, "n gh gw"]) -> Float[Tensor, "n gh gw"]:
    return functional.avg_pool2d(functional.pad(x, (1, 1, 1, 1), mode="replicate"), 3, 1)
