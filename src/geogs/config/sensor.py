"""Settings of depth sensors: how far what they measure is believed."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Positive, Range, Settings, Share


@dataclass(frozen=True)
class DepthSensorConfig(Settings, group="sensor"):
    """The noise of measured depth, where ``input.depth`` uses it.

    The deviation of an inverse depth d is the root of ``deviation^2 + (share d)^2 + (lateral g)^2``
    with the change g of inverse depth from pixel to pixel.
    """

    deviation: Positive = 0.0015
    """Of an inverse depth, per metre: what grows with the square of depth, such as 1.5 mm at 1 m
    and 24 mm at 4 m, as structured light and stereo have it."""
    share: Share = 0.005
    """Part of the depth that is wrong in common: calibration, temperature."""
    lateral: Annotated[float, Range(0, 100)] = 0.5
    """Pixels of the working image by which a depth may belong to another place."""
    edge: Annotated[float, Range(above=0, most=1)] = 0.04
    """Relative step of depth between neighbouring pixels that is an edge, where nothing is
    believed, nor on the next pixels."""
    near: Annotated[float, Range(above=0, most=1e3)] = 0.1
    """Metres from which on depths are believed ..."""
    far: Annotated[float, Range(above="near", most=1e4)] = 10.0
    """... and up to which."""
