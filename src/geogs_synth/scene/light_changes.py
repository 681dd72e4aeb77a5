"""Lamps of a scene that are switched while a sequence is taken."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

_OFF, _BRIGHT = 0.0, 2.0
"""Gains of a lamp that is off, and of one that is turned up in its place."""


@dataclass(frozen=True)
class LightChanges:
    """Gains of l lights, which change at k times."""

    times: Float64[np.ndarray, "k"]
    """Seconds, increasing."""
    gains: Float64[np.ndarray, "k+1 l"]
    """Factors on the colours of the lights before the first time, between them, and after."""


def switched_by_thirds(lights: int, seconds: float) -> LightChanges:
    """All lights as they are at first; then every other one is off, and the rest bright; then
    the other way round."""
    is_even = np.arange(lights) % 2 == 0
    first = np.where(is_even, _OFF, _BRIGHT)
    second = np.where(is_even, _BRIGHT, _OFF)
    return LightChanges(
        np.array([1.0, 2.0]) * seconds / 3, np.stack([np.ones(lights), first, second])
    )
