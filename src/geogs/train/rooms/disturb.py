"""From light to the pixels of an imperfect camera: exposure, blur, tone, noise, compression."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.train.rooms.draw import Draw
from geogs.train.rooms.jpeg import compress
from geogs.train.rooms.options import RoomOptions

_MIDDLE = 0.2
"""Mean linear brightness after exposure."""
_TAPS = 9


@dataclass(frozen=True)
class _Clip:
    """How much each of b clips is disturbed."""

    strength: Float[Tensor, "b"]
    """0 is clean, 1 as in a poor video."""
    views: int

    def vary(
        self, draw: Draw, common: float, own: float, channels: int = 1
    ) -> Float[Tensor, "n c"]:
        """Gaussian numbers with one part common to a clip and one of each view's own."""
        b = len(self.strength)
        whole = draw.normal(common, b, 1, channels) + draw.normal(own, b, self.views, channels)
        return (self.strength[:, None, None] * whole).flatten(0, 1)

    def amount(self, draw: Draw, chance: float, low: float, high: float) -> Float[Tensor, "n"]:
        """Zero for most clips; for the others log-uniform, a little different in each view."""
        b = len(self.strength)
        value = draw.chance(chance, b) * self.strength * draw.log_uniform(low, high, b)
        return (value[:, None] * draw.log_uniform(0.6, 1.6, b, self.views)).flatten()


def develop(
    draw: Draw, options: RoomOptions, colour: Float[Tensor, "b v 3 h w"]
) -> Float[Tensor, "b v 3 h w"]:
    """Pictures (0..1 in 8-bit steps) of linear light, as different cameras would take them."""
    b, v = colour.shape[:2]
    clean = draw.chance(options.clean, b)
    strength = torch.where(clean, 0.05, draw.uniform(0.3, 1.0, b)) * options.disturbance
    clip = _Clip(strength, v)
    linear = _expose(draw, clip, colour)
    linear = _blur(draw, clip, linear.flatten(0, 1))
    linear = linear * _vignette(draw, clip, linear)
    image = _tone(draw, clip, linear)
    image = _noise(draw, clip, image)
    image = _compress(draw, clip, image)
    return ((image.clamp(0, 1) * 255).round() / 255).unflatten(0, (b, v))


def _expose(
    draw: Draw, clip: _Clip, colour: Float[Tensor, "b v 3 h w"]
) -> Float[Tensor, "b v 3 h w"]:
    """Brings clips to a common brightness, then off it; colour balance, too."""
    b, v = colour.shape[:2]
    # The mean of roots: a bright window or lamp does not make everything else black.
    level = colour.sqrt().mean((1, 2, 3, 4)).square()
    gain = _MIDDLE / level.clamp_min(1e-4) * draw.normal(0.35, b).exp()
    view = clip.vary(draw, 0.15, 0.12).exp().reshape(b, v, 1)
    balance = clip.vary(draw, 0.08, 0.03, 3).exp().reshape(b, v, 3)
    return colour * (gain[:, None, None] * view * balance)[..., None, None]


def _blur(draw: Draw, clip: _Clip, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Out of focus or moved during the exposure: the mean of a few displaced images."""
    n, _, h, w = image.shape
    scale = w / 512
    radius = scale * clip.amount(draw, 0.3, 0.3, 1.6)
    length = scale * clip.amount(draw, 0.3, 0.5, 5.0)
    angle = draw.uniform(-3.15, 3.15, n)
    way = torch.stack([angle.cos(), angle.sin()], -1) * length[:, None]
    k = torch.arange(_TAPS, device=image.device)
    spiral = ((k + 0.5) / _TAPS).sqrt()[:, None] * torch.stack(
        [(2.4 * k).cos(), (2.4 * k).sin()], -1
    )
    # Moves in another order than the spiral, or both would make one bent line.
    along = (k * 4 % _TAPS) / (_TAPS - 1) - 0.5
    shift = spiral * radius[:, None, None] + along[:, None] * way[:, None]
    x = torch.arange(w, device=image.device)
    y = torch.arange(h, device=image.device)[:, None]
    size = torch.tensor([w, h], device=image.device)
    total = torch.zeros_like(image)
    for tap in range(_TAPS):
        place = torch.stack(torch.broadcast_tensors(x, y), -1) + shift[:, tap, None, None]
        grid = (2 * place + 1) / size - 1
        total += torch.nn.functional.grid_sample(
            image, grid, padding_mode="border", align_corners=False
        )
    return total / _TAPS


def _vignette(draw: Draw, clip: _Clip, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Darkening towards the corners."""
    h, w = image.shape[-2:]
    x = (torch.arange(w, device=image.device) + 0.5) / w - 0.5
    y = ((torch.arange(h, device=image.device) + 0.5) / h - 0.5)[:, None] * (h / w)
    squared = (x * x + y * y) / (0.25 + 0.25 * (h / w) ** 2)
    return 1 - clip.amount(draw, 0.5, 0.05, 0.5).clamp_max(0.7)[:, None, None, None] * squared


def _tone(draw: Draw, clip: _Clip, linear: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Linear light to display values: shoulder, gamma, contrast, saturation."""
    n = len(linear)

    def number(common: float, own: float) -> Float[Tensor, "n 1 1 1"]:
        return clip.vary(draw, common, own).reshape(n, 1, 1, 1)

    # Highlights bend over instead of being cut off at once.
    knee = 0.6
    over = (linear - knee).clamp_min(0)
    bent = torch.minimum(linear, linear.new_tensor(knee)) + over / (1 + over)
    image = bent.clamp(1e-5, 1.0) ** (number(0.12, 0.05).exp() / 2.2)
    image = 0.5 + (image - 0.5) * number(0.15, 0.06).exp()
    grey = image.mean(1, keepdim=True)
    return grey + (image - grey) * number(0.25, 0.06).exp()


def _noise(draw: Draw, clip: _Clip, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Shot noise that grows with brightness, and read noise."""
    shot, read = clip.amount(draw, 0.7, 0.004, 0.06), clip.amount(draw, 0.7, 0.002, 0.02)
    variance = shot.square()[:, None, None, None] * image.clamp(0, 1)
    deviation = (variance + read.square()[:, None, None, None]).sqrt()
    return image + deviation * draw.normal(1.0, *image.shape)


def _compress(draw: Draw, clip: _Clip, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    step = clip.amount(draw, 0.5, 3.0, 25.0)
    lossy = compress(image.clamp(0, 1), step.clamp_min(0.5))
    return torch.where(step[:, None, None, None] > 0.5, lossy, image)
