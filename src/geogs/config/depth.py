"""Settings of the keyframes' dense depth."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DepthConfig:
    """Dense depth of a keyframe before any disk is made."""

    sigma_scale: float = 0.14
    """Completion: real over expected deviation of the tracker's inverse depth, above 0."""
    bending: float = 0.02
    """Completion: second difference of inverse depth per cell, over its median, that is usual."""
    membrane: float = 0.3
    """Completion: first difference of inverse depth per cell, over its median, that is usual."""
    edge_sharpness: float = 48.0
    """Completion: how fast smoothness falls with the image gradient (Lab, 0 to 1 per pixel)."""
    neighbours: int = 8
    """Keyframes to match with, at least 1."""
    parallax: float = 6.0
    """Best angle between the rays of two keyframes, degrees."""
    min_parallax: float = 1.0
    """Least usable angle, degrees."""
    max_parallax: float = 25.0
    """Largest usable angle, degrees."""
    max_turn: float = 35.0
    """Largest angle between viewing directions, degrees."""
    max_baseline_cosine: float = 0.97
    """Baselines closer to parallel than this are left to others where there is choice."""
    range_margin: float = 1.3
    """Factor by which the searched depths go beyond what the tracker saw, at least 1."""
    range_deviation: float = 0.1
    """Relative deviation below which the tracker's depth counts for the range."""
    plane_step: float = 0.8
    """Pixels that the median neighbour moves from plane to plane."""
    min_planes: int = 72
    """Fewest planes, at least 2."""
    max_planes: int = 144
    """Most planes."""
    window: int = 3
    """Side of the matching window in pixels, odd, at least 3."""
    variance_floor: float = 1e-5
    """Grey variance (grey in 0 to 1) below which a window counts as without texture."""
    support_radius: int = 3
    """Pixels over which matching costs are averaged, at least 0."""
    support_sharpness: float = 400.0
    """How fast that average forgets pixels of another colour (RGB in 0 to 1, squared)."""
    prior_pull: float = 0.3
    """Cost of a plane far from the tracker's depth where the tracker is sure."""
    prior_tolerance: float = 0.03
    """Relative distance from the tracker's inverse depth at which the pull is full."""
    sure_deviation: float = 0.05
    """Relative deviation at which the tracker is half sure."""
    small_jump: float = 0.1
    """Semi-global matching: cost of a step by one plane."""
    large_jump: float = 1.5
    """Semi-global matching: cost of a larger step where the image is flat."""
    jump_contrast: float = 30.0
    """Semi-global matching: how fast the large step gets cheaper with the grey difference."""
    refine_steps: int = 3
    """Refinement: photometric steps, each with a fit of local planes; at least 1."""
    patch_contrast: float = 200.0
    """Refinement: how fast a patch sample's weight falls with its grey difference, squared."""
    step_limit: float = 0.03
    """Refinement: largest step, relative to inverse depth."""
    photo_deviation: float = 0.07
    """Refinement: deviation of a photometric optimum times the root of its curvature."""
    tracker_scale: float = 0.2
    """Refinement: real over expected relative deviation of the tracker's depth."""
    fit_radius: int = 4
    """Local planes: pixels around the centre that make the fit."""
    fit_deviation: float = 0.01
    """Local planes: relative deviation at which a pixel counts half."""
    fit_tolerance: float = 0.01
    """Local planes: relative distance from the plane at which a pixel counts half."""
    fit_stiffness: float = 0.5
    """Local planes: weight of the previous slopes, in sure pixels at distance 1."""
    guide_contrast: float = 200.0
    """Local planes: how fast a pixel's weight falls with its colour difference, squared."""
    plane_deviation: float = 0.003
    """Local planes: usual relative distance of a surface from them."""
    average_reach: float = 0.01
    """Check: relative distance within which depths of several keyframes are averaged."""
    agreement_reach: float = 0.015
    """Check: relative distance within which another keyframe's depth supports a pixel."""
    violation_distance: float = 0.05
    """Check: relative distance in front of another keyframe's depth that speaks against it."""
    repair_below: float = 0.4
    """Check: confidence below which a pixel takes the depth that others agree on."""
    repair_votes: float = 1.0
    """Check: sum of the others' confidences needed for that."""
    repair_confidence: float = 0.3
    """Check: confidence of such a pixel before the others' votes are counted."""
    vote_confidence: float = 0.5
    """Least confidence of a pixel that votes on points."""
    vote_support: float = 0.04
    """Relative distance from a depth within which a point lies on the surface."""
    vote_violation: float = 0.08
    """Relative distance in front of a depth beyond which a point lies in free space."""
    vote_free_views: int = 2
    """Fewest views in whose free space a point must lie to be removed."""
