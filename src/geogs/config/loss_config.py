"""Weights and thresholds of the mapping losses."""

from dataclasses import dataclass, field
from typing import Annotated

from geogs.config.setting import CountOrZero, Only, Positive, Range, Settings, Weight


@dataclass(frozen=True)
class LossAblation(Settings, group="mapping.loss.ablation"):
    """Other definitions of the losses, to compare with."""

    depth_relative: Annotated[bool, Only("python")] = True
    """Relative depth error times confidence; off for the plain difference in map units."""
    smoothness_rewards_edges: Annotated[bool, Only("python")] = False
    """Add the second printed term of L_ds, which wants a depth step at every image edge."""


@dataclass(frozen=True)
class LossConfig(Settings, group="mapping.loss"):
    """Weights and thresholds of the mapping losses.

    Every term is the sum over its valid pixels divided by the number of all pixels of the view.
    """

    depth_weight: Weight = 0.15
    """L_d, rendered depth against the keyframe's depth."""
    edge_factor: Weight = 10.0
    """Factor on the weight of L_d near jumps of the keyframe's depth, where disks end."""
    edge_reach: Annotated[CountOrZero, Only("python")] = 3
    """Pixels of the render around such a jump that are near it."""
    measured_factor: Annotated[Weight, Only("python")] = 13.0
    """Factor on the weight of L_d in keyframes whose depth a sensor measured."""
    normal_weight: Annotated[Weight, Only("run")] = 0.05
    """L_n, rendered normal against a monocular prior's where there is one."""
    normal_consistency_weight: Weight = 0.05
    """L_nc, rendered normal against the normal of the rendered depth."""
    distortion_weight: Weight = 0.2
    """L_dist, spread of the depths along a ray over the map's length unit."""
    opacity_weight: Weight = 0.1
    """1 - alpha, closes holes."""
    silhouette_weight: Weight = 0.3
    """alpha in the sky, and outside the masks where there are masks."""
    smoothness_weight: Weight = 0.0
    """L_ds, edge-aware smoothness of depth over its median."""
    l1_weight: Weight = 4.0
    """L_1, difference between a view and its neighbour warped into it."""
    l1_huber: Annotated[float, Range(0, 100), Only("python")] = 1.345
    """Deviations of noise between two views up to which their difference is quadratic in L_1; 0
    for the plain absolute value."""
    l1_cut: Annotated[float, Range(1e-9, 10), Only("python")] = 0.1
    """Grey difference (of 1) from which L_1 is constant."""
    ncc_weight: Weight = 0.5
    """L_ncc, 1 - normalised cross-correlation."""
    ncc_patch: Annotated[int, Range(3, 15, odd=True)] = 5
    """Side of the correlation window in pixels of the photometric image."""
    ncc_reject: Annotated[float, Range(1e-9, 2), Only("python")] = 0.9
    """Windows with 1 - NCC of this or more are taken for occluded or changed."""
    photo_texture: Annotated[Weight, Only("python")] = 0.5
    """A pixel around which grey varies by v times its noise (variances) counts v / (v + this) in
    L_1, and in L_ncc the window around it; 0 counts all alike."""
    ssim_weight: Weight = 0.0
    """L_ssim, 1 - structural similarity; slow on a CPU."""
    occlusion: Annotated[Positive, Only("python")] = 2.25
    """Depth difference to the neighbour's depth from which a pixel is hidden, in pixels of the
    photometric image that it is worth at 10 degrees of parallax."""
    occlusion_ratio: Annotated[float, Range(0, below=1), Only("python")] = 0.0
    """The same as a part of the depth whatever the camera, the paper's tau; 0 takes the pixels."""
    colour: bool = False
    """L_1 and L_ssim over red, green and blue, as the paper has it, instead of grey; L_ncc is grey
    always."""
    photo_blur: Annotated[float, Range(0, 100), Only("python")] = 0.3
    """Standard deviation in pixels by which the photometric images are smoothed."""
    ablation: LossAblation = field(default_factory=LossAblation)
