"""Exposure of one view relative to another, as a gain and an offset, and the noise of both."""

from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.gpu.kernels import kernels_for

_SOURCE = Path(__file__).parent / "cuda" / "light.cu"
_ROUNDS = 12
_SCALE = 0.02
"""Scale of the residuals of grey values; surfaces that hide each other differ by more."""
_PLAIN = 0.01
"""Standard deviation of grey values below which gain and offset cannot be distinguished."""
_FEWEST = 50
"""Least sum of the pixels' weights for an estimate."""
_LARGEST_GAIN = 8.0
USUAL_NOISE = 1e-4
"""Default variance of the noise of grey values (of 1), where it was not measured."""
LEAST_NOISE = 1e-6
"""Least variance of the noise, about that of rounding to 8 bits."""
_THREADS = 1024
"""Threads of the one block, as many as one may have."""


def identity_exposure(device: torch.device | str) -> Float[Tensor, "3"]:
    """Gain 1, offset 0, the usual noise."""
    return torch.tensor([1.0, 0.0, USUAL_NOISE], device=device)


def relative_exposure(
    grey: Float[Tensor, "n"], other: Float[Tensor, "n"], usable: Bool[Tensor, "n"]
) -> Float[Tensor, "2"]:
    """Estimate the gain and offset that bring most grey values to those of another view.

    The fit of the line allows errors in both values alike (total least squares): with noise a
    plain regression underestimates the gain, and along a chain of views these errors multiply.
    Pixels that do not agree lose their weight (Cauchy's), and where the values hardly vary the
    gain stays near 1. Returns gain 1 and offset 0 if too few pixels agree. Does not wait for a GPU.
    """
    if grey.device.type == "cuda":
        return relative_exposure_on_gpu(grey, other, usable)
    weight = usable.to(grey.dtype)
    for n in range(_ROUNDS):
        total = weight.sum().clamp(min=1e-12)
        mean_x, mean_y = (weight * grey).sum() / total, (weight * other).sum() / total
        x, y = grey - mean_x, other - mean_y
        # As if both also showed an equal texture of deviation ``_PLAIN``.
        xx, yy, xy = (
            (weight * a * b).sum() / total + _PLAIN**2 for a, b in ((x, x), (y, y), (x, y))
        )
        apart = yy - xx
        gain = (apart + (apart.square() + 4 * xy.square()).sqrt()) / (2 * xy.clamp(min=1e-9))
        gain = gain.clamp(1 / _LARGEST_GAIN, _LARGEST_GAIN)
        residual = (y - gain * x) / (1 + gain.square()).sqrt()
        # Wide at first, so that the start, where all count, is not decisive.
        scale = _SCALE * max(1.0, 4.0 * (1 - n / (_ROUNDS / 2)))
        weight = usable / (1 + (residual / scale).square())
    found = torch.stack([gain, mean_y - gain * mean_x])
    return torch.where(weight.sum() > _FEWEST, found, identity_exposure(grey.device)[:2].to(grey))


def relative_exposure_on_gpu(
    grey: Float[Tensor, "n"], other: Float[Tensor, "n"], usable: Bool[Tensor, "n"]
) -> Float[Tensor, "2"]:
    """:func:`relative_exposure` by one CUDA kernel, in float32."""
    exposure = grey.new_empty(2)
    values = (grey.contiguous(), other.contiguous(), usable.contiguous())
    kernels_for(_SOURCE, grey.device)["fit_light"](
        1, _THREADS, *values, len(grey), _ROUNDS, _SCALE, _PLAIN, _FEWEST, _LARGEST_GAIN, exposure
    )
    return exposure


def noise_between(
    grey: Float[Tensor, "n"],
    other: Float[Tensor, "n"],
    texture: Float[Tensor, "n"],
    usable: Bool[Tensor, "n"],
) -> Float[Tensor, ""]:
    """Variance of the noise in the grey values of each of two views of the same exposure.

    From the median difference of their grey values where the first has least ``texture``, so that
    slightly misaligned pixels do not count as noise. The usual noise if too few can be compared.
    Does not wait for a GPU.
    """
    order = torch.where(usable, texture, torch.inf).argsort(stable=True)
    bare = usable.sum() // 4
    apart = (grey - other).abs()[order]
    apart = torch.where(torch.arange(len(apart), device=grey.device) < bare, apart, torch.inf)
    # A normal distribution's standard deviation is 1.4826 times its median absolute value.
    deviation = 1.4826 * apart.sort().values[(bare // 2)[None]][0]
    found = (deviation.square() / 2).clamp(min=LEAST_NOISE)
    return torch.where(bare > _FEWEST, found, USUAL_NOISE)
