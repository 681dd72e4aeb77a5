"""Settings of the front end."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class TrackingConfig:
    """Motion filter, frame graph and dense bundle adjustment.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

    operator: Literal["auto", "classical", "own", "raft", "droid"] = "auto"
    """What measures image motion; auto takes classical, which needs no weights."""
    weights: str = ""
    """File with the operator's weights; empty looks for one (geogs weights says where)."""
    keyframe_flow: float = 0.025
    """Median motion since the last keyframe that makes a frame a keyframe, of the long edge."""
    cull_distance: float = 0.012
    """A keyframe nearer than this to the one before it is removed again, of the long edge."""
    init_keyframes: int = 12
    """Keyframes gathered before the map is started, at least 4."""
    min_parallax: float = 0.02
    """Motion that rotation does not explain, needed to start, of the long edge."""
    window: int = 8
    """Most recent keyframes whose poses the local adjustment moves."""
    depth_window: int = 11
    """Most recent keyframes whose inverse depth it moves, at least the window."""
    radius: int = 3
    """Every keyframe is matched with this many before it."""
    proximity_window: int = 25
    """Older keyframes among which further neighbours of a new one are looked for."""
    proximity_distance: float = 0.2
    """Largest frame distance of such neighbours, of the long edge."""
    proximity_pairs: int = 2
    """Most such neighbours per keyframe."""
    local_rounds: int = 2
    """Rounds of flow and adjustment per keyframe."""
    local_iterations: int = 3
    """Gauss-Newton steps per round."""
    remeasure: float = 0.5
    """A pair is matched again when its reprojection has moved by this many pixels."""
    min_texture: float = 0.05
    """A frame is skipped when less than this fraction of it has structure."""
    min_matched: float = 0.12
    """The camera is lost when less than this fraction of a keyframe finds a match."""
    max_residual: float = 0.008
    """The camera is lost when the median reprojection error exceeds this, of the long edge."""
    relocalise: int = 5
    """Recent keyframes, and as many older ones in turn, tried when the camera is lost."""
    recognised: float = 0.25
    """A keyframe that an image was recognised as counts if this fraction of it finds a match."""
    patience: int = 15
    """Frames with texture in which the camera stays lost before another segment is begun."""
    huber: float = 0.5
    """Standard deviations of the flow beyond which a match counts linearly."""
    global_rounds: int = 4
    """Most rounds of flow and adjustment over all keyframes at the end."""
    global_iterations: int = 10
    """Gauss-Newton steps per round."""
    global_remeasure: float = 0.25
    """As remeasure, in the global adjustment, pixels."""
    global_distance: float = 0.5
    """Largest frame distance of a pair in the global adjustment, of the long edge."""
    global_suppression: int = 3
    """Pairs within this many keyframes of a chosen one are left out."""
    global_pairs: int = 10
    """Most pairs per keyframe in the global adjustment."""
