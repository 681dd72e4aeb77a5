"""From light to the pixels of an imperfect camera: exposure, blur, tone, noise, compression."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.camera.jpeg import compress
from geogs_synth.camera.motion_blur import mean_of_displaced
from geogs_synth.camera.random_flaws import RandomFlaws
from geogs_synth.draw import Draw

_MIDDLE = 0.2
"""Brightness of a clip before its exposure is disturbed."""
_KNEE = 0.6
"""Brightness above which highlights are compressed instead of clipped."""


def develop(
    noise: Draw, flaws: RandomFlaws, colour: Float[Tensor, "b v 3 h w"]
) -> Float[Tensor, "b v 3 h w"]:
    """Pictures (0..1 in 8-bit steps) of linear light, as imperfect cameras would take them."""
    b, v = colour.shape[:2]
    # The mean of roots: a bright window or lamp does not make everything else black.
    level = colour.sqrt().mean((1, 2, 3, 4)).square().clamp_min(1e-4)
    gain = (_MIDDLE / level).repeat_interleave(v) * flaws.exposure
    linear = colour.flatten(0, 1) * (gain[:, None] * flaws.balance)[..., None, None]
    linear = _blur(linear, flaws.blur) * _vignette(linear, flaws.vignette)
    image = _tone(linear, flaws)
    shot, read = _each(flaws.shot), _each(flaws.read)
    deviation = (shot.square() * image.clamp(0, 1) + read.square()).sqrt()
    image = (image + deviation * noise.normal(1.0, *image.shape)).clamp(0, 1)
    step = flaws.compression
    image = torch.where(_each(step) > 0, compress(image, step.clamp_min(0.5)), image)
    return ((image.clamp(0, 1) * 255).round() / 255).unflatten(0, (b, v))


def _each(number: Float[Tensor, "n"]) -> Float[Tensor, "n 1 1 1"]:
    return number[:, None, None, None]


def _blur(
    image: Float[Tensor, "n 3 h w"], displacements: Float[Tensor, "n t 2"]
) -> Float[Tensor, "n 3 h w"]:
    """The mean of displaced images."""
    h, w = image.shape[-2:]
    across, down = 2 * displacements[..., 0], 2 * displacements[..., 1] * (w / h)
    shifts = torch.stack([across, down], -1)[:, :, None, None].unbind(1)
    return mean_of_displaced(image, shifts)


def _vignette(
    image: Float[Tensor, "n 3 h w"], loss: Float[Tensor, "n"]
) -> Float[Tensor, "n 1 h w"]:
    h, w = image.shape[-2:]
    x = (torch.arange(w, device=image.device) + 0.5) / w - 0.5
    y = ((torch.arange(h, device=image.device) + 0.5) / h - 0.5)[:, None] * (h / w)
    return 1 - _each(loss) * (x * x + y * y) / (0.25 + 0.25 * (h / w) ** 2)


def _tone(linear: Float[Tensor, "n 3 h w"], flaws: RandomFlaws) -> Float[Tensor, "n 3 h w"]:
    """Linear light to display values."""
    over = (linear - _KNEE).clamp_min(0)
    bent = linear.clamp_max(_KNEE) + over / (1 + over)
    image = bent.clamp(1e-5, 1.0) ** _each(flaws.gamma)
    image = 0.5 + (image - 0.5) * _each(flaws.contrast)
    grey = image.mean(1, keepdim=True)
    return grey + (image - grey) * _each(flaws.saturation)
