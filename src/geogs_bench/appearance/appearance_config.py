"""The settings of the baseline, with the public values as defaults."""

from dataclasses import dataclass


@dataclass(frozen=True)
class AppearanceConfig:
    """Training settings: 2DGS (Huang et al. 2024) as gsplat 1.5 runs it.

    Step numbers are out of ``steps``; a run with a time budget stretches the whole schedule over
    it, so that step = steps * elapsed / budget.
    """

    steps: int = 30_000
    """Length of the schedule to which the step numbers below refer."""
    sh_degree: int = 3
    """Highest degree of the spherical harmonics, 0 to 3."""
    sh_interval: int = 1000
    """Steps after which a further degree is used."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the photometric loss; the rest is L1."""
    normal_weight: float = 0.05
    """Weight of the consistency of disk normals with those of the depth map."""
    normal_start: int = 7000
    """Step from which normals count."""
    refine_start: int = 500
    """Step after which disks are added and removed."""
    refine_stop: int = 15_000
    """Step after which no disks are added or removed."""
    refine_every: int = 100
    """Steps between refinements."""
    refine_iterations: int = 25
    """Fewest real iterations between refinements, so that gradients of several views count."""
    grow_gradient: float = 2e-4
    """Mean image gradient, in half image sizes, above which a disk is doubled or split."""
    grow_scale: float = 0.01
    """Disks up to this size are doubled, larger ones split; in scene scales."""
    split_shrink: float = 1.6
    """Factor by which the two halves of a split disk shrink."""
    prune_opacity: float = 0.05
    """Disks less opaque than this are removed."""
    prune_scale: float = 0.1
    """Larger disks are removed, in scene scales."""
    prune_scale_start: int = 3000
    """Step after which disks are removed for their size."""
    means_rate: float = 1.6e-4
    """Learning rate of positions at the start, in scene scales."""
    means_decay: float = 0.01
    """Factor on this rate at the end of the exponential decay."""
    scales_rate: float = 5e-3
    """Learning rate of the logarithms of the sizes."""
    quaternions_rate: float = 1e-3
    """Learning rate of rotations."""
    opacities_rate: float = 5e-2
    """Learning rate of the logits of opacities."""
    sh_constant_rate: float = 2.5e-3
    """Learning rate of the colour that does not depend on the direction."""
    sh_rest_rate: float = 1.25e-4
    """Learning rate of the other coefficients."""
    initial_opacity: float = 0.1
    """Opacity of a new disk at a start point."""
    scene_margin: float = 1.1
    """Scene scale over the largest distance of a camera from the middle of the cameras."""
    near: float = 0.01
    """Disks with centres nearer to a camera are not rendered, units of the poses."""
    min_alpha: float = 0.5
    """Pixels with less opacity have no depth, since their median lies behind all disks."""
