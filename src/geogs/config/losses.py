"""Weights and thresholds of the mapping losses."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LossConfig:
    """Weights and thresholds of the mapping losses.

    Every term is the sum over its valid pixels divided by the number of all pixels of the view.
    """

    depth_weight: float = 2.0
    """L_d, rendered depth against the keyframe's depth; unitless, at least 0."""
    depth_relative: bool = True
    """Relative depth error times confidence; off for the plain difference in map units."""
    normal_weight: float = 0.05
    """L_n, rendered normal against a monocular prior's where there is one; unitless, at least 0."""
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
