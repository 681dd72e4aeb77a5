"""Settings of the keyframes' dense depth."""

from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.config.setting import Range, Settings


@dataclass(frozen=True)
class DepthConfig(Settings, group="mapping.depth"):
    """Dense depth of a keyframe before any disk is made."""

    engine: Literal["auto", "classical", "network", "joint", "tracker"] = "auto"
    """Who finds depth: matching without a network, the network of geogs train depth, both, each
    where it is surer (auto on a GPU; on a CPU that is classical), or nobody: the tracker's own
    depth, enlarged, as the paper has it."""
    weights: str = ""
    """Weights file of the network; "" takes the one that is found."""
    planes: Annotated[int, Range(2, 256)] = 144
    """Most planes of inverse depth that are searched, and half of them at least."""
