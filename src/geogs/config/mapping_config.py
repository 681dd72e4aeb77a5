"""Settings of the disk map and its training."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from geogs.config.loss_config import LossConfig
from geogs.config.setting import (
    Angle,
    Count,
    CountOrZero,
    Fraction,
    NamesFile,
    Only,
    Positive,
    Range,
    Settings,
    Weight,
)

FINAL_STEPS = 600, 3000
"""Steps of the final training where nobody says how many, on the CPU and on a GPU."""


@dataclass(frozen=True)
class DiskConfig(Settings, group="mapping.disk"):
    """Creation, start and removal of disks. Lengths in units of the map's depth.

    The unit u is the median depth of the first keyframe.
    """

    stride: Annotated[int, Range(1, 100)] = 3
    """A candidate every stride-th pixel of the render."""
    edge_stride: Annotated[int, Range(1, 100)] = 2
    """The same near jumps of the keyframe's depth, if that is less: disks there are as much smaller
    and hardly overhang the edge."""
    insert_confidence: Annotated[Fraction, Only("python")] = 0.3
    """Least confidence of a depth that makes a disk at once; the rest follows later."""
    fill_confidence: Annotated[Fraction, Only("python")] = 0.1
    """Least confidence of a depth that makes a disk where nothing better has come since."""
    fit_normals: Annotated[bool, Only("python")] = True
    """Lay a new disk into the plane of the depths around its pixel, as far as to the next disk,
    where there is one; off takes that of the points nearest to it, as the paper does."""
    scale_factor: Annotated[Positive, Only("python")] = 0.6
    """Initial standard deviation in distances to the nearest points."""
    bound_spacing: Annotated[bool, Only("python")] = True
    """Keep that distance within 0.3 to 1.5 of the distance between samples, so that a stray point
    makes neither a speck nor a blanket; off as in the paper."""
    planarity_threshold: Annotated[Fraction, Only("python")] = 0.05
    """Below this planarity the initial scale shrinks."""
    planarity_shrink: Annotated[Positive, Only("python")] = 0.5
    """Factor of that shrinking; the paper's is 0.1."""
    opacity: Annotated[float, Range(1e-4, 0.9999), Only("python")] = 0.7
    """Initial opacity."""
    max_scale: Annotated[Positive, Only("python")] = 0.05
    """Largest standard deviation, in u."""
    min_scale: Annotated[float, Range(1e-9, "max_scale"), Only("python")] = 4e-4
    """Smallest standard deviation, in u."""
    carve: bool = True
    """Remove disks that stand in the free space of keyframes, and make none there."""


@dataclass(frozen=True)
class PhotoConfig(Settings, group="mapping.photo"):
    """Choice of the keyframes that check each other's depth by their images (L_mv)."""

    max_view_angle: Annotated[Angle, Only("python")] = 35.0
    """Largest angle between the optical axes, degrees."""
    candidates: Annotated[int, Range(1, 1000), Only("python")] = 6
    """Partners kept per keyframe."""
    per_step: Annotated[int, Range(1, 64)] = 2
    """Partners drawn in each step."""
    fresh: Annotated[bool, Only("python")] = False
    """Render the partners anew in every step for the occlusion test, as the paper does; off takes
    what they showed when they were trained last."""
    compensate_exposure: bool = True
    """Bring all keyframes into the same light (gain and offset of their grey values) for L_1."""


@dataclass(frozen=True)
class DepthConfig(Settings, group="mapping.depth"):
    """Dense depth of a keyframe before any disk is made."""

    engine: Literal["auto", "classical", "network", "joint", "tracker"] = "auto"
    """Depth estimator: classical matching, the network of geogs train depth, joint (both, each
    where it is more confident), or tracker, whose own depth is enlarged, as in the paper. auto is
    joint on a GPU, classical on a CPU."""
    weights: Annotated[str, NamesFile()] = ""
    """Weights file of the network; "" takes the one that is found."""
    planes: Annotated[int, Range(2, 256)] = 144
    """Most planes of inverse depth that are searched, and a third of them at least."""
    bare_planes: bool = True
    """Bare parts of an image, as walls, lie on the planes of what is known around them where the
    search is unsure."""


@dataclass(frozen=True)
class MapAblation(Settings, group="mapping.ablation"):
    """Other ways to start disks and to move them, to compare with."""

    initialisation: Literal["local_plane", "random"] = "local_plane"
    """Disks start in the plane of the points around them, or turned at random and with the scales
    of 3DGS: the distance to the three nearest points."""
    start: Annotated[Literal["depths", "points"], Only("reconstruct")] = "depths"
    """Disks start where searched depths see more than the map, also while it is trained, or once,
    at sparse points as in the paper's runs on DTU: those of the data set, or of features of its
    images."""
    map_update: Annotated[Literal["blended", "coherent", "per_keyframe"], Only("run")] = "blended"
    """Motion of the map with a correction of the poses: each disk with all keyframes that see it,
    all by one similarity (the paper's), or each with the keyframe that made it."""


@dataclass(frozen=True)
class MappingConfig(Settings, group="mapping"):
    """The disk map and its training."""

    render_long_edge: Annotated[int, Range(16, 16384)] = 320
    """Longer side of the rendered maps in pixels; never above the working image."""
    photo_scale: Annotated[float, Range(0.1, 16)] = 2.0
    """The images of L_mv are this much larger than the render, at most the working image."""
    when: Annotated[Literal["auto", "online", "after"], Only("run")] = "auto"
    """Map each keyframe as soon as it is final, or all at once after the final bundle adjustment,
    which takes less time and shows nothing before; auto: after, where images come from files,
    nobody looks on, and there is a final training."""
    lag: Annotated[CountOrZero, Only("run")] = 4
    """A keyframe that is not removed any more (see tracking.keyframe-distance) is mapped once this
    many later ones are so, too, so that its depth can be searched."""
    window: Annotated[Count, Only("run")] = 8
    """Recent keyframes that are trained together."""
    iterations: Annotated[CountOrZero, Only("run")] = 8
    """Steps per keyframe."""
    views_per_step: Annotated[CountOrZero, Only("run")] = 2
    """Views of the window in each step; 0 sums the loss over the whole window as the paper does."""
    final_iterations: Annotated[int | Literal["auto"], Range(0, 10**6), Only("run")] = "auto"
    """Single-view steps over all keyframes after the final bundle adjustment; 0 stops online;
    auto: 600 on a CPU, 3000 on a GPU, where they take a few seconds."""
    final_depth: Annotated[bool, Only("run")] = True
    """Search the depths of a map that was made on the way once more with the final poses."""
    lr_position: Weight = 6e-4
    """Adam step of positions, in u."""
    lr_final: Annotated[float, Range(1e-9, 1)] = 0.1
    """Factor that the learning rates fall to over the final iterations."""
    pose_iterations: Annotated[CountOrZero, Only("run")] = 2
    """Pose-only steps of a refinement on the map; 0 leaves the poses to the tracker, as a live run
    always does, which does not wait for the map."""
    pose_every: Annotated[Count, Only("run")] = 4
    """Mapped keyframes from one refinement of the latest poses to the next; the paper's is 1."""
    pose_lr: Annotated[Weight, Only("run")] = 4e-4
    """Adam step of the pose tangents: radians, and u for translations."""
    max_spread: Weight = 0.01
    """Surfaces take the mean depth of a ray where the median differs by less (at a slant: along the
    normal), else the median; 0: the median."""
    plane_reach: Annotated[float, Range(0, 0.04)] = 0.02
    """Surfaces take the average depth over the planes of the pixels around that differ by less,
    which takes out noise; 0: what each ray has itself."""
    disk: DiskConfig = field(default_factory=DiskConfig)
    photo: PhotoConfig = field(default_factory=PhotoConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    ablation: MapAblation = field(default_factory=MapAblation)

    @property
    def may_follow(self) -> bool:
        """Whether the map can be made after the video: no online one, and there is a training."""
        return self.when != "online" and self.final_iterations != 0

    def final_steps(self, on_gpu: bool) -> int:
        """Steps of the final training."""
        if self.final_iterations == "auto":
            return FINAL_STEPS[on_gpu]
        return self.final_iterations

    def steps_at_once(self, keyframes: int, on_gpu: bool) -> int:
        """Training steps of a map that is made of so many keyframes at once: those of the final
        training, or what all would have had on the way where that is more."""
        return max(self.final_steps(on_gpu), self.iterations * keyframes)

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
