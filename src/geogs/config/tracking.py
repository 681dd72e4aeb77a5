"""Settings of the front end."""

from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.config.setting import Basic, Count, CountOrZero, Positive, Range, Settings, Share, Weight


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
    blur_share: Share = 0.7
    """A frame with less than this fraction of the latest frames' sharpness is blurred ..."""
    blur_wait: Weight = 0.4
    """... and becomes a keyframe only when it has moved by this much more; 0 takes it at once."""
    cull_distance: Share = 0.012
    """A keyframe nearer than this to the one before it is removed again, of the long edge."""
    init_keyframes: Annotated[int, Range(4, 1000)] = 12
    """Keyframes gathered before the map is started."""
    min_parallax: Share = 0.005
    """Motion that rotation does not explain, needed to try to start, of the long edge."""
    start_deviation: Positive = 0.2
    """The map is started when the depths of its first keyframes are known to this, in the median:
    relative standard deviation by what matches and poses leave open."""
    start_overlap: Share = 0.3
    """While it cannot be started: share of the first keyframe that the last has to see still for
    the first to be kept."""
    window: Annotated[int, Range(1, 1000)] = 8
    """Most recent keyframes whose poses the local adjustment moves."""
    window_baseline: Weight = 0.0
    """The window reaches further back until the camera has moved by this much of the depth ..."""
    window_most: Annotated[int, Range("window", 1000)] = 24
    """... but never over more keyframes than this."""
    depth_window: Annotated[int, Range("window", 1000)] = 11
    """Most recent keyframes whose inverse depth it moves."""
    radius: Annotated[int, Range(1, 100)] = 3
    """Every keyframe is matched with this many before it."""
    proximity_window: Count = 25
    """Older keyframes among which further neighbours of a new one are looked for."""
    proximity_distance: Weight = 0.2
    """Largest frame distance of such neighbours, of the long edge."""
    proximity_pairs: CountOrZero = 2
    """Most such neighbours per keyframe."""
    local_rounds: Count = 2
    """Rounds of flow and adjustment per keyframe."""
    local_iterations: Count = 3
    """Gauss-Newton steps per round."""
    remeasure: Weight = 0.5
    """A pair is matched again when its reprojection has moved by this many pixels."""
    min_texture: Share = 0.05
    """A frame is skipped when less than this fraction of it has structure."""
    min_matched: Share = 0.12
    """The camera is lost when less than this fraction of a keyframe finds a match."""
    min_known: Share = 0.1
    """Where the camera is cannot be told when the depth of less than this fraction of a keyframe is
    known to 30 % and found in the image: then it is followed as if it only turned."""
    max_residual: Annotated[float, Range(above=0, most=1)] = 0.008
    """The camera is lost when the median reprojection error exceeds this, of the long edge."""
    min_ncc: Annotated[float, Range(-1, 1)] = 0.5
    """A frame counts as located where the images agree: least median correlation (NCC) of windows
    of 9 x 9 pixels, reprojected by pose and depth. Unlike images come to 0, one place to 0.7 and
    more. Where too few windows have texture the flow alone decides whether the camera is still
    where it was followed to; a map is never started, nor a camera found again, without evidence."""
    relocalise: CountOrZero = 5
    """Recent keyframes, and as many older ones in turn, tried when the camera is lost."""
    recognised: Share = 0.25
    """A keyframe that an image was recognised as counts if this fraction of it finds a match."""
    patience: Count = 15
    """Frames with texture in which the camera stays lost before another segment is begun."""
    huber: Positive = 0.5
    """Standard deviations of the flow beyond which a match counts linearly."""
    moving: Annotated[float, Range(0, 1000)] = 3.0
    """A region is held for something that moves, and left out, where its matches contradict a rigid
    scene by this many times what is usual; 0 leaves nothing out."""
    global_rounds: CountOrZero = 4
    """Most rounds of flow and adjustment over all keyframes at the end."""
    global_iterations: Count = 10
    """Gauss-Newton steps per round."""
    global_remeasure: Weight = 0.25
    """As remeasure, in the global adjustment, pixels."""
    global_distance: Weight = 0.5
    """Largest frame distance of a pair in the global adjustment, of the long edge."""
    global_suppression: CountOrZero = 3
    """Pairs within this many keyframes of a chosen one are left out."""
    global_pairs: Count = 10
    """Most pairs per keyframe in the global adjustment."""
