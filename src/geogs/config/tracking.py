"""Settings of the front end."""

from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.config.setting import Basic, Count, Range, Settings, Share


@dataclass(frozen=True)
class TrackingConfig(Settings, group="tracking"):
    """Motion filter, frame graph and dense bundle adjustment.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

    operator: Annotated[Literal["auto", "classical", "own", "droid"], Basic()] = "auto"
    """What measures image motion; auto takes classical, which needs no weights."""
    weights: Annotated[str, Basic()] = ""
    """File with the operator's weights; empty looks for one (geogs weights says where)."""
    keyframe_flow: Share = 0.025
    """Median motion since the last keyframe that makes a frame a keyframe, of the long edge."""
    keyframe_overlap: Share = 0.7
    """A frame that has moved a fifth of that becomes one, too, when less than this fraction of the
    last keyframe finds a match in it."""
    init_keyframes: Annotated[int, Range(4, 1000)] = 12
    """Keyframes gathered before the map is started."""
    window: Annotated[int, Range(1, 1000)] = 8
    """Most recent keyframes whose poses the local adjustment moves."""
    patience: Count = 15
    """Frames with texture in which the camera stays lost before another segment is begun."""
    moving: Annotated[float, Range(0, 1000)] = 3.0
    """A region is held for something that moves, and left out, where its matches contradict a rigid
    scene by this many times what is usual; 0 leaves nothing out."""
