"""The light in random rooms."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.draw import Draw
from geogs_synth.scene.batch import where
from geogs_synth.scene.rooms import Lights

MOST_LIGHTS = 3


def draw_lights(draw: Draw, size: Float[Tensor, "b 3"], views: int, change: float) -> Lights:
    """One to three lights under the ceiling; in some of the rooms they change between views."""
    b = len(size)
    first, second = _draw(draw, size), _draw(draw, size)
    moment = draw.integers(max(views - 1, 1), b) + 1
    later = draw.chance(change, b)[:, None] & (torch.arange(views) >= moment[:, None])
    return where(later, second, first)


def _draw(draw: Draw, size: Float[Tensor, "b 3"]) -> Lights:
    """The light of a single view."""
    b = len(size)
    n = (b, 1, MOST_LIGHTS)
    position = draw.uniform(0.05, 0.95, *n, 3)
    position[..., 2] = 1 - 0.5 * position[..., 2].square()
    there = torch.arange(MOST_LIGHTS) <= draw.integers(MOST_LIGHTS, b, 1, 1)
    warmth = draw.uniform(-0.2, 0.35, *n)[..., None]
    white = 1 + warmth * torch.tensor([1.0, 0.1, -1.0])
    power = there * draw.log_uniform(0.7, 6.0, *n)
    above = draw.log_uniform(0.15, 1.0, b, 1, 1) * (1 + draw.uniform(-0.12, 0.12, b, 1, 3))
    # Light from the floor is weaker and of another colour.
    floor = draw.uniform(0.4, 0.9, b, 1, 1) * (1 + draw.uniform(-0.12, 0.12, b, 1, 3))
    return Lights(
        position=position * size[:, None, None],
        colour=power[..., None] * white,
        radius=draw.log_uniform(0.02, 0.3, *n),
        above=above,
        below=above * floor,
    )
