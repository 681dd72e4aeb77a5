"""Settings of loops: how they are found, closed, and corrected globally."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, Count, CountOrZero, Settings, Weight


@dataclass(frozen=True)
class LoopConfig(Settings, group="loop"):
    """Where loops are looked for and how many are kept.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

    enabled: Annotated[bool, Basic()] = True
    """Look for loops, close them, and recognise places when the camera is lost."""
    min_gap: Count = 15
    """Keyframes that lie at least between the two views of a loop."""
    appearance: CountOrZero = 5
    """Candidates taken from the index per keyframe; 0 looks only where the present poses say."""
    close_every: Count = 5
    """Keyframes between two corrections, at least."""
    strain: Weight = 5.0
    """Squared error of a loop at the present poses, in its own variances, from which it calls for a
    correction. Variances are cautious: right loops come to 1 or 2, where 7 would be exact."""
    matches: bool = False
    """Adjust the matches of loops and of the frame graph together with the relative poses, depths
    included, when a loop is closed (the paper's Sim(3) bundle adjustment); off leaves it at the
    relative poses."""
    min_change: Weight = 0.002
    """Corrections that move no keyframe by more than this are not worth it for the map: radians,
    parts of its median depth, or of its scale."""
    global_ba_every: Annotated[CountOrZero, Basic("--global-ba-every")] = 0
    """Keyframes between two bundle adjustments of all keyframes; 0 leaves that to the end."""
