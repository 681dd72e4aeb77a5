"""Sizes of our multi-view depth network."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Range, Settings

Channels = Annotated[int, Range(1, 4096)]


@dataclass(frozen=True)
class DepthNetworkOptions(Settings, group="training.network"):
    """Sizes of the network."""

    planes: Annotated[int, Range(4, 256)] = 64
    """Depths that are tried, evenly spaced in their logarithm."""
    groups: Annotated[int, Range(1, 64)] = 8
    """Groups of channels whose correlations are kept apart; divides ``matching``."""
    matching: Annotated[int, Range("groups", 4096)] = 32
    """Channels of what is matched between views."""
    fine_groups: Annotated[int, Range(1, 64)] = 4
    """The same of the search at 1/2; divides ``fine_matching``."""
    fine_matching: Annotated[int, Range("fine_groups", 4096)] = 16
    """Channels of what is matched there."""
    encoder: tuple[Channels, ...] = (24, 48, 96)
    """Channels of the matching encoder at 1/2, 1/4 and 1/8."""
    context: tuple[Channels, ...] = (32, 48, 80, 128, 176)
    """Channels of what the keyframe alone says at 1/2 to 1/32."""
    volume: tuple[Channels, ...] = (64, 80, 128, 176)
    """Channels of the network over the plane scores at 1/4 to 1/32."""
    metadata: Channels = 32
    """Channels of the small network that rates a plane in one neighbour."""
    decoder: Channels = 48
    """Channels at 1/2, where the result is read off."""
