"""Sizes of our own flow network."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Range, Settings

Channels = Annotated[int, Range(1, 4096)]


@dataclass(frozen=True)
class NetworkOptions(Settings, group="training.network"):
    """Sizes of the network."""

    levels: tuple[Annotated[int, Range(1, 256)], ...] = (2, 8, 32)
    """Pixels between the descriptors of each level of the pyramid, powers of two."""
    stem: Channels = 32
    """Channels at 1/2 of the resolution."""
    middle: Channels = 64
    """Channels at 1/4."""
    deep: Channels = 96
    """Channels at 1/8."""
    hidden: Channels = 96
    """Channels of the recurrent state."""
    context: Channels = 64
    """Channels of what an image gives to every iteration."""
    motion: Channels = 80
    """Channels that the correlation windows are reduced to."""
