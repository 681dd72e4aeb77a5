"""Lamps of a scene that are switched during a sequence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True)
class LightChanges:
    """Gains of l lights, which change at k times."""

    times: Float64[np.ndarray, "k"]
    """Seconds, increasing."""
    gains: Float64[np.ndarray, "k+1 l"]
    """Factors on the colours of the lights before the first time, between them, and after."""


def switched_by_thirds(lights: int, seconds: float) -> LightChanges:
    """Three lightings: all lights as they are; every other one off and the rest twice as bright;
    and the reverse."""
    is_even = np.arange(lights) % 2 == 0
    gains = np.stack([np.ones(lights), 2.0 * ~is_even, 2.0 * is_even])
    return LightChanges(np.array([1.0, 2.0]) * seconds / 3, gains)
