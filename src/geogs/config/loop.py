"""Settings of loops: how they are found, closed, and corrected globally."""

from dataclasses import dataclass, field
from typing import Annotated

from geogs.config.setting import (
    Angle,
    Basic,
    Count,
    CountOrZero,
    Positive,
    Range,
    Settings,
    Share,
    Weight,
)


@dataclass(frozen=True)
class RetrievalOptions(Settings, group="loop.retrieval"):
    """Appearance features and the vocabulary that grows from them."""

    features: Count = 800
    """Most ORB features per keyframe, strongest of each image cell first."""
    indexed: Count = 300
    """How many of them the index looks up and stores; the rest serve verification."""
    fast_threshold: Annotated[int, Range(1, 255)] = 7
    """Least grey-level step of a corner: low, so that dark exposures still give features."""
    word_radius: Annotated[int, Range(0, 256)] = 50
    """Bits (of 256) within which a descriptor belongs to an existing word."""
    words: Count = 6144
    """Size at which the vocabulary stops growing; bounds the cost of a keyframe."""


@dataclass(frozen=True)
class VerificationOptions(Settings, group="loop.verification"):
    """When two views count as views of one place."""

    ratio: Annotated[float, Range(above=0, most=1)] = 0.87
    """A match must be this much nearer than the second nearest descriptor."""
    reprojection: Annotated[float, Range(above=0, most=1)] = 0.006
    """Largest error of an inlier of the pose, of the long edge."""
    epipolar: Annotated[float, Range(above=0, most=1)] = 0.002
    """Largest distance of an inlier from its epipolar line, of the long edge."""
    min_inliers: Annotated[int, Range(6, 100_000)] = 15
    """Fewest matches that agree with the pose."""
    min_epipolar: Annotated[int, Range(8, 100_000)] = 25
    """The same where no depth is known and a match binds only half as much."""
    min_share: Share = 0.3
    """Least share of all matches that do."""
    min_spread: Share = 0.25
    """Least share of the cells of a 4 x 4 raster that hold inliers, in the poorer image: one
    picture that hangs in two rooms is no loop."""
    depth_tolerance: Positive = 0.15
    """Relative deviation within which an inlier's depths in both views agree, up to one scale."""
    min_consistent: Share = 0.6
    """Least share of the inliers with depth in both views for which they do."""
    max_scale: Annotated[float, Range(1, 1e6)] = 3.0
    """Largest factor between the scales of both views' depths, either way."""
    min_matched: Share = 0.15
    """Dense check: least share of the cells whose flow agrees with the pose, in each direction."""
    min_matched_alone: Share = 0.3
    """The same where only the present poses, and no features, speak for the loop."""
    max_residual: Annotated[float, Range(above=0, most=1)] = 0.0033
    """Dense check: largest median reprojection error of the flow, of the long edge."""
    max_contradiction: Share = 0.1
    """Dense check: largest share of the surface of one view, where the other looks at it, through
    which the other sees. Tells look-alikes apart where their shapes differ within the view."""
    max_turn: Angle = 3.0
    """Dense check: largest rotation in degrees between the poses found in the two directions."""
    min_ncc: Annotated[float, Range(-1, 1)] = 0.5
    """Dense check: least median correlation of the images at those poses, in each direction."""


@dataclass(frozen=True)
class LoopConfig(Settings, group="loop"):
    """Where loops are looked for and how many are kept.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

    enabled: Annotated[bool, Basic()] = True
    """Look for loops, close them, and recognise places when the camera is lost."""
    min_gap: Count = 15
    """Keyframes that lie at least between the two views of a loop."""
    max_distance: Weight = 0.29
    """Flow distance below which the present poses make a pair a candidate, of the long edge (22
    cells of 8 pixels at 616 pixels, as HI-SLAM2 has it)."""
    rotation_weight: Share = 0.3
    """Weight of the flow with the rotation in that distance, the rest is without."""
    max_angle: Angle = 120.0
    """Largest angle in degrees between the orientations of such a pair."""
    max_baseline: Weight = 1.5
    """Largest distance between their centres, of the keyframe's median depth."""
    measured: Count = 48
    """Most such pairs, nearest first, whose flow distance is computed: bounds the cost."""
    appearance: CountOrZero = 5
    """Candidates taken from the index per keyframe; 0 looks only where the present poses say."""
    min_score: Share = 0.05
    """Least similarity of such a candidate, of that of a keyframe with itself."""
    verified: Count = 4
    """Most candidates of a keyframe that are verified: bounds the cost."""
    suppression: CountOrZero = 3
    """A loop rules out others whose ends together lie within this many keyframes of its own."""
    max_loops: Count = 2
    """Most loops per keyframe."""
    lag: CountOrZero = 2
    """Keyframes for which a search may run beside tracking before it is waited for."""
    close_every: Count = 5
    """Keyframes between two corrections, at least."""
    strain: Weight = 5.0
    """Squared error of a loop at the present poses, in its own variances, from which it calls for a
    correction. Variances are cautious: right loops come to 1 or 2, where 7 would be exact."""
    matches: bool = False
    """Adjust the matches of loops and of the frame graph together with the relative poses, depths
    included, when a loop is closed (the paper's Sim(3) bundle adjustment); off leaves it at the
    relative poses."""
    kept: Count = 200
    """Relative poses of loops from which on older ones are thinned out."""
    min_change: Weight = 0.002
    """Corrections that move no keyframe by more than this are not worth it for the map: radians,
    parts of its median depth, or of its scale."""
    agreeing: Count = 2
    """Loops that have to agree before a segment is joined to another."""
    join_tolerance: Positive = 0.12
    """Within which they agree: radians, parts of the median depth, or of the scale."""
    global_ba_every: Annotated[CountOrZero, Basic("--global-ba-every")] = 0
    """Keyframes between two bundle adjustments of all keyframes; 0 leaves that to the end."""
    retrieval: RetrievalOptions = field(default_factory=RetrievalOptions)
    verification: VerificationOptions = field(default_factory=VerificationOptions)
