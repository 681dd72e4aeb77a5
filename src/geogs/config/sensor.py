"""Settings of depth sensors: how far what they measure is believed."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Positive, Range, Settings, Share


@dataclass(frozen=True)
class DepthSensorConfig(Settings, group="sensor"):
    """The noise of measured depth, where ``input.depth`` uses it.

    The deviation of an inverse depth d is the root of ``deviation^2 + (ratio d)^2 + (g / 2)^2``
    with the change g of inverse depth from pixel to pixel.
    """

    deviation: Positive = 0.0015
    """Of an inverse depth, per metre: what grows with the square of depth, such as 1.5 mm at 1 m
    and 24 mm at 4 m, as structured light and stereo have it."""
    ratio: Share = 0.005
    """Fraction of the depth that is wrong in common: calibration, temperature."""
    far: Annotated[float, Range(above=0.1, most=1e4)] = 10.0
    """Metres up to which depths are believed."""
