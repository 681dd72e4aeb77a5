"""Settings of the keyframes' dense depth."""

from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.config.setting import (
    Angle,
    Count,
    Only,
    Positive,
    Range,
    Settings,
    Share,
    Weight,
)


@dataclass(frozen=True)
class DepthConfig(Settings, group="mapping.depth"):
    """Dense depth of a keyframe before any disk is made."""

    engine: Literal["auto", "classical", "network", "joint", "tracker"] = "auto"
    """Who finds depth: matching without a network, the network of geogs train depth, both, each
    where it is surer (auto on a GPU; on a CPU that is classical), or nobody: the tracker's own
    depth, enlarged, as the paper has it."""
    weights: str = ""
    """Weights file of the network; "" takes the one that is found."""
    network_edge: Annotated[int, Range(32, 16384)] = 512
    """Longest edge of the images that the network sees, pixels; at most that of the input."""
    sigma_scale: Annotated[Positive, Only("run")] = 0.14
    """Completion: real over expected deviation of the tracker's inverse depth."""
    bending: Annotated[Positive, Only("run")] = 0.02
    """Completion: second difference of inverse depth per cell, over its median, that is usual."""
    membrane: Annotated[Positive, Only("run")] = 0.3
    """Completion: first difference of inverse depth per cell, over its median, that is usual."""
    edge_sharpness: Annotated[Weight, Only("run")] = 48.0
    """Completion: how fast smoothness falls with the image gradient (Lab, 0 to 1 per pixel)."""
    neighbours: Annotated[int, Range(1, 16)] = 8
    """Keyframes to match with."""
    parallax: Annotated[float, Range(above=0, most=180)] = 6.0
    """Best angle between the rays of two keyframes, degrees."""
    min_parallax: Annotated[float, Range(0, below=180)] = 1.0
    """Least usable angle, degrees."""
    max_parallax: Annotated[float, Range(above="min_parallax", most=180)] = 25.0
    """Largest usable angle, degrees."""
    max_turn: Angle = 35.0
    """Largest angle between viewing directions, degrees."""
    max_baseline_cosine: Annotated[float, Range(-1, 1)] = 0.97
    """Baselines closer to parallel than this are left to others where there is choice."""
    range_margin: Annotated[float, Range(1, 1000), Only("run")] = 1.3
    """Factor by which the searched depths go beyond what the tracker saw."""
    range_deviation: Annotated[Weight, Only("run")] = 0.1
    """Relative deviation below which the tracker's depth counts for the range."""
    plane_step: Annotated[float, Range(0.01, 100)] = 0.8
    """Pixels that the median neighbour moves from plane to plane."""
    min_planes: Annotated[int, Range(2, 256)] = 72
    """Fewest planes."""
    max_planes: Annotated[int, Range("min_planes", 256)] = 144
    """Most planes."""
    window: Annotated[int, Range(3, 15, odd=True)] = 3
    """Side of the matching window in pixels."""
    variance_floor: Annotated[float, Range(1e-12, 1)] = 1e-5
    """Grey variance (grey in 0 to 1) below which a window counts as without texture."""
    support_radius: Annotated[int, Range(0, 8)] = 3
    """Pixels over which matching costs are averaged."""
    support_sharpness: Weight = 400.0
    """How fast that average forgets pixels of another colour (RGB in 0 to 1, squared)."""
    prior_pull: Annotated[Weight, Only("run")] = 0.3
    """Cost of a plane far from the tracker's depth where the tracker is sure."""
    prior_tolerance: Annotated[Positive, Only("run")] = 0.03
    """Relative distance from the tracker's inverse depth at which the pull is full."""
    sure_deviation: Annotated[Positive, Only("run")] = 0.05
    """Relative deviation at which the tracker is half sure."""
    small_jump: Weight = 0.1
    """Semi-global matching: cost of a step by one plane."""
    large_jump: Weight = 1.5
    """Semi-global matching: cost of a larger step where the image is flat."""
    jump_contrast: Weight = 30.0
    """Semi-global matching: how fast the large step gets cheaper with the grey difference."""
    refine_steps: Annotated[int, Range(1, 100)] = 3
    """Refinement: photometric steps, each with a fit of local planes."""
    patch_contrast: Weight = 200.0
    """Refinement: how fast a patch sample's weight falls with its grey difference, squared."""
    step_limit: Annotated[float, Range(above=0, most=1)] = 0.03
    """Refinement: largest step, relative to inverse depth."""
    photo_deviation: Positive = 0.07
    """Refinement: deviation of a photometric optimum times the root of its curvature."""
    tracker_scale: Positive = 0.2
    """Refinement: real over expected relative deviation of the tracker's depth."""
    fit_radius: Annotated[int, Range(1, 32)] = 4
    """Local planes: pixels around the centre that make the fit."""
    fit_deviation: Positive = 0.01
    """Local planes: relative deviation at which a pixel counts half."""
    fit_tolerance: Positive = 0.01
    """Local planes: relative distance from the plane at which a pixel counts half."""
    fit_stiffness: Weight = 0.5
    """Local planes: weight of the previous slopes, in sure pixels at distance 1."""
    guide_contrast: Weight = 200.0
    """Local planes: how fast a pixel's weight falls with its colour difference, squared."""
    plane_deviation: Positive = 0.003
    """Local planes: usual relative distance of a surface from them."""
    average_reach: Positive = 0.01
    """Check: relative distance within which depths of several keyframes are averaged."""
    agreement_reach: Positive = 0.015
    """Check: relative distance within which another keyframe's depth supports a pixel."""
    violation_distance: Share = 0.05
    """Check: relative distance in front of another keyframe's depth that speaks against it."""
    repair_below: Share = 0.4
    """Check: confidence below which a pixel takes the depth that others agree on."""
    repair_votes: Weight = 1.0
    """Check: sum of the others' confidences needed for that."""
    repair_confidence: Share = 0.3
    """Check: confidence of such a pixel before the others' votes are counted."""
    vote_confidence: Share = 0.5
    """Least confidence of a pixel that votes on points."""
    vote_support: Share = 0.04
    """Relative distance from a depth within which a point lies on the surface."""
    vote_violation: Share = 0.08
    """Relative distance in front of a depth beyond which a point lies in free space."""
    vote_free_views: Count = 2
    """Fewest views in whose free space a point must lie to be removed."""
