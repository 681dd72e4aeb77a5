"""Every setting, as one tree of frozen dataclasses; it is saved with each result.

The string under a field is its help text: meaning, unit, range.
"""

from dataclasses import dataclass, field, replace
from typing import Literal


@dataclass(frozen=True)
class InputConfig:
    """How the source is read."""

    intrinsics: str = "auto"
    """auto, a file, or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels of the source image."""
    long_edge: int = 512
    """Longer side of the working image in pixels; smaller sources are not enlarged, 0 keeps all."""
    start: int = 0
    """First frame of the source, from 0."""
    stop: int | None = None
    """Frame of the source before which to stop; none reads to the end."""
    stride: int = 1
    """Use every stride-th frame, at least 1."""


@dataclass(frozen=True)
class TrackingConfig:
    """Motion filter, frame graph and dense bundle adjustment.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

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


@dataclass(frozen=True)
class LossConfig:
    """Weights and thresholds of the mapping losses.

    Every term is the sum over its valid pixels divided by the number of all pixels of the view.
    """

    depth_weight: float = 2.0
    """L_d, rendered depth against the keyframe's depth; unitless, at least 0."""
    depth_relative: bool = True
    """Relative depth error times confidence; off for the plain difference in map units."""
    normal_weight: float = 0.0
    """L_n, rendered normal against a monocular normal prior; unitless, at least 0."""
    normal_consistency_weight: float = 0.02
    """L_nc, rendered normal against the normal of the rendered depth; unitless, at least 0."""
    distortion_weight: float = 0.1
    """L_dist, spread of the depths along a ray over the map's length unit; at least 0."""
    opacity_weight: float = 0.02
    """1 - alpha, closes holes; unitless, at least 0."""
    silhouette_weight: float = 0.1
    """alpha outside the masks, where there are masks; unitless, at least 0."""
    smoothness_weight: float = 0.0
    """L_ds, edge-aware smoothness of depth over its median; unitless, at least 0."""
    smoothness_eta: float = 10.0
    """Decay of smoothness with the image gradient (image in [0, 1]); 1 to 30."""
    smoothness_rewards_edges: bool = False
    """Add the second printed term of L_ds, which wants a depth step at every image edge."""
    min_alpha: float = 0.5
    """Rendered depth and normals count where alpha exceeds this; in [0, 1)."""
    l1_weight: float = 1.0
    """L_1, grey difference between a view and its neighbour warped into it; at least 0."""
    l1_huber: float = 0.02
    """Grey difference (of 1) up to which L_1 is quadratic; 0 for the plain absolute value."""
    l1_cut: float = 0.2
    """Grey difference (of 1) from which L_1 is constant; above l1_huber."""
    ncc_weight: float = 0.5
    """L_ncc, 1 - normalised cross-correlation; unitless, at least 0."""
    ncc_patch: int = 7
    """Side of the correlation window in pixels of the photometric image; odd, 3 to 15."""
    ncc_reject: float = 0.9
    """Windows with 1 - NCC of this or more are taken for occluded or changed; in (0, 2]."""
    ncc_min_variance: float = 1e-4
    """Windows of the reference with less grey variance have no texture to correlate; above 0."""
    ncc_texture: float = 1e-4
    """A window of grey variance v weighs v / (v + this); 0 weighs all windows alike."""
    ncc_min_coverage: float = 0.7
    """Windows with a smaller valid share are left out; in (0, 1]."""
    ssim_weight: float = 0.0
    """L_ssim, 1 - structural similarity; unitless, at least 0; slow on a CPU."""
    occlusion: float = 2.25
    """Depth difference to the neighbour's depth from which a pixel is hidden, in pixels of the
    photometric image that it is worth at 10 degrees of parallax; above 0."""
    photo_blur: float = 0.3
    """Standard deviation in pixels by which the photometric images are smoothed; at least 0."""
    photo_gradient: Literal["exact", "sobel"] = "exact"
    """Image derivative of the warp: of the bilinear interpolation, or of a 3x3 Sobel filter."""


@dataclass(frozen=True)
class DiskConfig:
    """Where disks are made, how they start and when they go. Lengths in units of the map's depth.

    The unit u is the median depth of the first keyframe.
    """

    stride: int = 3
    """A candidate every stride-th pixel of the render, at least 1."""
    insert_alpha: float = 0.4
    """A pixel gets a disk where the map's alpha is below this, in (0, 1)."""
    insert_behind: float = 0.05
    """... or where the map lies this fraction of the depth behind a sure depth."""
    insert_confidence: float = 0.3
    """Least confidence of a depth that makes a disk at once; the rest follows later."""
    fill_confidence: float = 0.1
    """Least confidence of a depth that makes a disk where nothing better has come since."""
    initialisation: Literal["local_plane", "random"] = "local_plane"
    """Disks start in the plane of the points around them, or round, turned at random and as large
    as those points are apart (3DGS's start, to compare with)."""
    neighbours: int = 12
    """Points of the local plane fit, at least 4."""
    scale_factor: float = 0.6
    """Initial standard deviation in distances to the nearest points."""
    planarity_threshold: float = 0.05
    """Below this planarity the initial scale shrinks, in [0, 1]."""
    planarity_shrink: float = 0.5
    """Factor of that shrinking; the paper's is 0.1."""
    opacity: float = 0.7
    """Initial opacity, in (0, 1)."""
    max_scale: float = 0.05
    """Largest standard deviation, in u."""
    min_scale: float = 4e-4
    """Smallest standard deviation, in u."""
    prune_opacity: float = 0.05
    """Disks below this opacity are removed."""
    split_share: float = 0.0
    """Part of the disks that is split in two, where the losses pull hardest, each time that the
    training over all keyframes reaches a split; in [0, 1)."""
    split_times: tuple[float, ...] = (0.2, 0.35, 0.5)
    """When that is, in parts of that training."""
    split_pixels: float = 1.0
    """Disks with no standard deviation above this many pixels at u are not split."""
    carve_every: int = 10
    """Keyframes between votes of all keyframes against disks in free space."""


@dataclass(frozen=True)
class PhotoConfig:
    """Which keyframes check each other's depth by their images (L_mv)."""

    parallax: float = 8.0
    """Preferred parallax angle in degrees."""
    min_parallax: float = 2.0
    """Degrees."""
    max_parallax: float = 25.0
    """Degrees."""
    looking_within: float = 35.0
    """Largest angle between the optical axes, degrees."""
    candidates: int = 6
    """Partners kept per keyframe."""
    per_step: int = 2
    """Partners drawn in each step."""


@dataclass(frozen=True)
class MappingConfig:
    """The disk map and its training."""

    render_long_edge: int = 320
    """Longer side of the rendered maps in pixels; never above the working image."""
    photo_scale: float = 2.0
    """The images of L_mv are this much larger than the render, at most the working image."""
    lag: int = 4
    """A keyframe is mapped once this many later ones exist, so that its depth can be searched."""
    window: int = 8
    """Recent keyframes that are trained together."""
    history: int = 2
    """Older keyframes drawn at random into each window."""
    iterations: int = 8
    """Steps per keyframe."""
    views_per_step: int = 2
    """Views of the window in each step; 0 sums the loss over the whole window as the paper does."""
    final_iterations: int = 600
    """Single-view steps over all keyframes after the final bundle adjustment; 0 stops online."""
    final_depth: bool = True
    """Search all keyframe depths once more with the final poses."""
    lr_position: float = 6e-4
    """Adam step of positions, in u."""
    lr_quaternion: float = 4e-3
    """Adam step of quaternions."""
    lr_scale: float = 0.02
    """Adam step of log scales."""
    lr_opacity: float = 0.05
    """Adam step of opacity logits."""
    lr_final: float = 0.1
    """Factor that the learning rates fall to over the final iterations."""
    pose_iterations: int = 2
    """Pose-only steps per mapped keyframe; 0 leaves the poses to the tracker."""
    pose_lr: float = 4e-4
    """Adam step of the pose tangents: radians, and u for translations."""
    map_update: Literal["coherent", "per_keyframe"] = "coherent"
    """How the map follows a correction of the poses."""
    max_spread: float = 0.01
    """Surfaces take the mean depth of a ray where the median differs by less, else the median."""
    disk: DiskConfig = field(default_factory=DiskConfig)
    photo: PhotoConfig = field(default_factory=PhotoConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    loss: LossConfig = field(default_factory=LossConfig)

    @property
    def pose_loss(self) -> LossConfig:
        """The terms of the pose step: L_d, L_n and L_mv with their mapping weights."""
        return replace(
            self.loss,
            normal_consistency_weight=0.0,
            distortion_weight=0.0,
            opacity_weight=0.0,
            silhouette_weight=0.0,
            smoothness_weight=0.0,
        )


@dataclass(frozen=True)
class MeshConfig:
    """Surface extraction."""

    voxel: float | None = None
    """Voxel size in map units; chosen from depth, budget and memory limit if none is given."""
    voxel_per_pixel: float = 1.0
    """Chosen voxel size in footprints of a depth map's pixel at the median depth, above 0."""
    truncation: float = 4.0
    """Voxels in front of and behind a surface in which distances are averaged, at least 2."""
    max_depth: float | None = None
    """Farther pixels are left out, map units; twice the 95 % quantile if none is given."""
    min_weight: float = 1.5
    """Sum of view weights that a voxel needs to count as seen, above 0; just behind a surface a
    view counts less than in front, so 1.5 asks for two sure views."""
    triangle_budget: int = 1_500_000
    """Triangles that a chosen voxel size aims at, to about 20 %."""
    memory_limit: float = 2.0
    """Most memory for the volume in GiB."""
    min_component_faces: int = 100
    """Connected parts with fewer faces are removed."""
    min_component_fraction: float = 0.001
    """Parts with fewer faces than this fraction of the largest part's are removed, 0 to 1."""
    max_components: int | None = None
    """Keep only so many of the largest parts; none keeps all (1 suits a single object)."""
    colour: bool = True
    """Colour the vertices from the keyframe images."""


@dataclass(frozen=True)
class Config:
    """All settings of a run."""

    seed: int = 0
    """Random seed; same seed, same machine, same result on the CPU."""
    input: InputConfig = field(default_factory=InputConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)


@dataclass(frozen=True)
class SearchConfig:
    """How much is done for a map from known poses, and where depth is looked for."""

    steps_per_view: int = 30
    """Training steps for every image where no time is given, at least 1."""
    least_steps: int = 300
    """Fewest training steps where no time is given."""
    most_steps_per_view: int = 200
    """Most training steps for every image, whatever the time."""
    depth_share: float = 0.6
    """Most of the time up to then that the depths may take, in (0, 1]; images for which it does not
    last get none and only serve to find those of the others."""
    output_share: float = 0.2
    """Part of a given time that is kept for the mesh and the report, in [0, 1)."""
    first_edge: int = 128
    """First look at the scene: longer side of its images, pixels."""
    first_views: int = 8
    """First look: images whose depth is searched."""
    margin: float = 1.3
    """Factor by which searched depths go beyond those that are known, at least 1."""
    repeat: bool = True
    """Search all depths a second time, between the limits that the first time has shown."""


def known_pose_mapping() -> MappingConfig:
    """Mapping where poses are exact: the images say more about the surface than the first depths.

    So photo-consistency weighs more than in a run, down to faint texture, and the occlusion test is
    sharper; disks move in smaller steps.
    """
    loss = LossConfig(
        depth_weight=0.5,
        normal_consistency_weight=0.05,
        distortion_weight=0.2,
        opacity_weight=0.1,
        silhouette_weight=0.3,
        l1_weight=4.0,
        l1_huber=0.005,
        l1_cut=0.1,
        ncc_patch=5,
        ncc_reject=0.5,
        ncc_min_variance=1e-8,
        ncc_texture=1e-6,
        occlusion=1.0,
    )
    return MappingConfig(
        lr_position=3e-4,
        lr_final=0.03,
        max_spread=0.003,
        photo=PhotoConfig(per_step=4),
        loss=loss,
    )


@dataclass(frozen=True)
class ReconstructConfig:
    """All settings of a reconstruction from known poses."""

    seed: int = 0
    """Random seed; same seed, same machine and no time limit, same result on the CPU."""
    input: InputConfig = field(default_factory=InputConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    mapping: MappingConfig = field(default_factory=known_pose_mapping)
    mesh: MeshConfig = field(default_factory=MeshConfig)


Preset = Literal["fast", "default", "accurate"]


def preset(name: Preset) -> Config:
    """The settings of a preset.

    ``fast`` stops after the online map; ``accurate`` works on larger images and trains longer.
    """
    base = Config()
    if name == "fast":
        mapping = replace(
            base.mapping, iterations=5, pose_iterations=0, final_iterations=100, final_depth=False
        )
        return replace(base, mapping=mapping)
    if name == "accurate":
        mapping = replace(base.mapping, render_long_edge=400, iterations=15, final_iterations=1500)
        return replace(base, input=replace(base.input, long_edge=640), mapping=mapping)
    return base


def reconstruct_preset(name: Preset) -> ReconstructConfig:
    """The settings of a preset for known poses.

    ``fast`` works on small images and searches depths once; ``accurate``, for a GPU, renders at the
    size of the images.
    """
    base = ReconstructConfig()
    if name == "fast":
        return replace(
            base,
            input=replace(base.input, long_edge=400),
            search=replace(base.search, repeat=False, steps_per_view=15),
            mapping=replace(base.mapping, render_long_edge=256),
        )
    if name == "accurate":
        disk = replace(base.mapping.disk, stride=5)
        return replace(
            base,
            input=replace(base.input, long_edge=800),
            search=replace(base.search, steps_per_view=200, most_steps_per_view=1000),
            mapping=replace(base.mapping, render_long_edge=800, photo_scale=1.0, disk=disk),
        )
    return base
