"""Settings of the disk map and its training."""

from dataclasses import dataclass, field, replace
from typing import Literal

from geogs.config.depth import DepthConfig
from geogs.config.losses import LossConfig


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
    map_update: Literal["blended", "coherent", "per_keyframe"] = "blended"
    """How the map follows a correction of the poses: each disk with all keyframes that see it in
    place, all by one similarity (the paper's), or each with the keyframe that made it."""
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
