"""Random flaws of the cameras that take the clips."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.draw import Draw

TAPS = 9
"""Number of displaced images whose mean is a blurred one."""


@dataclass(frozen=True)
class RandomFlaws:
    """Flaws of each of n pictures; those of a clip resemble each other."""

    exposure: Float[Tensor, "n"]
    """Factor on the light."""
    balance: Float[Tensor, "n 3"]
    """Factor on each colour."""
    blur: Float[Tensor, "n t 2"]
    """Displacements of the images that a blurred one is the mean of, in image widths."""
    vignette: Float[Tensor, "n"]
    """Loss of light in the corners."""
    gamma: Float[Tensor, "n"]
    """Exponent from light to display values."""
    contrast: Float[Tensor, "n"]
    """Factor on the distance from middle grey."""
    saturation: Float[Tensor, "n"]
    """Factor on the distance from grey."""
    shot: Float[Tensor, "n"]
    """Standard deviation, at white, of the noise that grows with brightness."""
    read: Float[Tensor, "n"]
    """Standard deviation of the noise that does not depend on brightness."""
    compression: Float[Tensor, "n"]
    """Quantisation step of lossy compression in 8-bit levels; 0 for none."""


@dataclass(frozen=True)
class _ClipFlaws:
    """Strength of the flaws of each of b clips."""

    strength: Float[Tensor, "b"]
    """0 is clean, 1 as in a poor video."""
    views: int

    def vary(
        self, draw: Draw, common: float, own: float, channels: int = 1
    ) -> Float[Tensor, "n c"]:
        """Factors around 1 with one part common to a clip and one of each view's own."""
        b = len(self.strength)
        whole = draw.normal(common, b, 1, channels) + draw.normal(own, b, self.views, channels)
        return (self.strength[:, None, None] * whole).exp().flatten(0, 1)

    def amount(self, draw: Draw, chance: float, low: float, high: float) -> Float[Tensor, "n"]:
        """Zero for most clips; for the others log-uniform, a little different in each view."""
        b = len(self.strength)
        value = draw.chance(chance, b) * self.strength * draw.log_uniform(low, high, b)
        return (value[:, None] * draw.log_uniform(0.6, 1.6, b, self.views)).flatten()


def draw_flaws(
    draw: Draw, clips: int, views: int, clean: float = 0.3, disturbance: float = 1.0
) -> RandomFlaws:
    """Flaws of the views of clips, clip after clip.

    The fraction ``clean`` of the clips has nearly none; ``disturbance`` scales those of the others.
    """
    nearly_none = draw.chance(clean, clips)
    strength = torch.where(nearly_none, 0.05, draw.uniform(0.3, 1.0, clips)) * disturbance
    some = _ClipFlaws(strength, views)
    brightness = draw.normal(0.35, clips, 1).exp().expand(-1, views).flatten()
    return RandomFlaws(
        exposure=brightness * some.vary(draw, 0.15, 0.12)[:, 0],
        balance=some.vary(draw, 0.08, 0.03, 3),
        blur=_blur(draw, some),
        vignette=some.amount(draw, 0.5, 0.05, 0.5).clamp_max(0.7),
        gamma=some.vary(draw, 0.12, 0.05)[:, 0] / 2.2,
        contrast=some.vary(draw, 0.15, 0.06)[:, 0],
        saturation=some.vary(draw, 0.25, 0.06)[:, 0],
        shot=some.amount(draw, 0.7, 0.004, 0.06),
        read=some.amount(draw, 0.7, 0.002, 0.02),
        compression=_steps(draw, some),
    )


def _blur(draw: Draw, some: _ClipFlaws) -> Float[Tensor, "n t 2"]:
    """Out of focus: a disc; moved during the exposure: a line. In widths of an image."""
    radius, length = some.amount(draw, 0.3, 6e-4, 3e-3), some.amount(draw, 0.3, 1e-3, 1e-2)
    angle = draw.uniform(-3.15, 3.15, len(radius))
    way = torch.stack([angle.cos(), angle.sin()], -1) * length[:, None]
    k = torch.arange(TAPS)
    spiral = torch.stack([(2.4 * k).cos(), (2.4 * k).sin()], -1)
    disc = ((k + 0.5) / TAPS).sqrt()[:, None] * spiral
    disc = disc - disc.mean(0)
    # The line in another order than the disc, or both would make one bent line.
    line = (k * 4 % TAPS) / (TAPS - 1) - 0.5
    return disc * radius[:, None, None] + line[:, None] * way[:, None]


def _steps(draw: Draw, some: _ClipFlaws) -> Float[Tensor, "n"]:
    steps = some.amount(draw, 0.7, 2.0, 18.0)
    return torch.where(steps < 0.5, 0.0, steps)
