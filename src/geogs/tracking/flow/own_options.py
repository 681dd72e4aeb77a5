"""Sizes of our own flow network."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NetworkOptions:
    """Sizes of the network."""

    levels: tuple[int, ...] = (2, 8, 32)
    """Pixels between the descriptors of each level of the pyramid, powers of two."""
    stem: int = 32
    """Channels at 1/2 of the resolution."""
    middle: int = 64
    """Channels at 1/4."""
    deep: int = 96
    """Channels at 1/8."""
    hidden: int = 96
    """Channels of the recurrent state."""
    context: int = 64
    """Channels of what an image gives to every iteration."""
    motion: int = 80
    """Channels that the correlation windows are reduced to."""
