"""The disks of the baseline: trainable shape and colour."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.lie import quaternion_to_matrix
from geogs.geometry.neighbors import nearest_neighbors
from geogs_bench.appearance.appearance_config import AppearanceConfig

FLOATS_PER_DISK = 61
"""Numbers per disk in the file format of 2DGS: 3 + 3 (normal) + 48 + 1 + 2 + 4."""
_NEIGHBOURS = 3
_SH_CONSTANT = 0.28209479177387814
"""The spherical harmonic of degree 0: sqrt(1 / 4 pi)."""


@dataclass(frozen=True)
class AppearanceDisks:
    """Trained parameters; one row a disk, world frame, units of the poses."""

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    """w, x, y, z, of any length."""
    log_scales: Float[Tensor, "n 2"]
    """Logarithms of the standard deviations along the two tangents."""
    opacity_logits: Float[Tensor, "n"]
    sh_constant: Float[Tensor, "n 1 3"]
    """Coefficient of degree 0."""
    sh_rest: Float[Tensor, "n k 3"]
    """Coefficients of all other degrees."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def bytes(self) -> int:
        """Size in the usual file format, float32."""
        return 4 * FLOATS_PER_DISK * len(self)

    @property
    def scales(self) -> Float[Tensor, "n 2"]:
        """Standard deviations along the two tangents."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """In (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def coefficients(self) -> Float[Tensor, "n k 3"]:
        """Spherical harmonics of all degrees."""
        return torch.cat([self.sh_constant, self.sh_rest], 1)

    def tensors(self) -> tuple[Tensor, ...]:
        """All parameters, in the order of the fields."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def map(self, function: Callable[[Tensor], Tensor]) -> "AppearanceDisks":
        """Apply a function to every parameter."""
        return AppearanceDisks(*(function(tensor) for tensor in self.tensors()))

    def detached(self) -> "AppearanceDisks":
        """A copy that training does not change."""
        return self.map(lambda tensor: tensor.detach().clone())

    def joined(self, other: "AppearanceDisks") -> "AppearanceDisks":
        """These disks, then the others."""
        pairs = zip(self.tensors(), other.tensors(), strict=True)
        return AppearanceDisks(*(torch.cat(pair) for pair in pairs))


def disks_at_points(
    points: Float[Tensor, "n 3"],
    colours: Float[Tensor, "n 3"],
    config: AppearanceConfig,
    generator: torch.Generator,
) -> AppearanceDisks:
    """Make a disk at each point, of a random direction.

    Colours are RGB in [0, 1]; the size is the root mean square distance of the three nearest
    neighbours.
    """
    n = len(points)
    device = points.device
    distance = nearest_neighbors(points, points, _NEIGHBOURS + 1)[0][:, 1:]
    size = distance.square().mean(1).sqrt().clamp(min=1e-7)
    quaternions = torch.rand((n, 4), generator=generator, device=device)
    logit = math.log(config.initial_opacity / (1 - config.initial_opacity))
    rest = (config.sh_degree + 1) ** 2 - 1
    return AppearanceDisks(
        points.float(),
        quaternions,
        size.float().log()[:, None].repeat(1, 2),
        torch.full((n,), logit, device=device),
        constant_from_colour(colours.float())[:, None],
        torch.zeros((n, rest, 3), device=device),
    )


def constant_from_colour(colour: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Coefficient of degree 0 that gives an RGB colour in [0, 1] in every direction."""
    return (colour - 0.5) / _SH_CONSTANT


class GradientStatistics:
    """Mean image gradient of each disk since the last refinement."""

    def __init__(self, count: int, device: torch.device) -> None:
        self._sum = torch.zeros(count, device=device)
        self._views = torch.zeros(count, device=device)

    def add(
        self, gradient: Float[Tensor, "n 2"], visible: Bool[Tensor, "n"], width: int, height: int
    ) -> None:
        """Add one image's gradient, given per pixel; it is counted in half image sizes."""
        norm = torch.hypot(gradient[:, 0] * (width / 2), gradient[:, 1] * (height / 2))
        self._sum += torch.where(visible, norm, 0.0)
        self._views += visible

    def mean(self) -> Float[Tensor, "n"]:
        """Mean norm over the images that showed the disk; 0 for disks that none showed."""
        return self._sum / self._views.clamp(min=1)


def refine(
    disks: AppearanceDisks,
    gradient: Float[Tensor, "n"],
    step: float,
    scene_scale: float,
    config: AppearanceConfig,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "k"], AppearanceDisks]:
    """Double small disks and split large ones where gradients are high; remove useless ones.

    Returns the rows that stay unchanged, and the new disks.
    """
    disks = disks.map(lambda tensor: tensor.detach())
    is_steep = gradient > config.grow_gradient
    small = disks.scales.amax(1) <= config.grow_scale * scene_scale
    split = is_steep & ~small
    doubles = disks.map(lambda tensor: tensor[is_steep & small])
    halves = split_disks(disks.map(lambda tensor: tensor[split]), config.split_shrink, generator)
    added = doubles.joined(halves)
    kept = torch.nonzero(~split & ~_useless(disks, step, scene_scale, config))[:, 0]
    useful = ~_useless(added, step, scene_scale, config)
    return kept, added.map(lambda tensor: tensor[useful])


def split_disks(
    disks: AppearanceDisks, shrink: float, generator: torch.Generator
) -> AppearanceDisks:
    """Two smaller disks for each, at points drawn from it, in its plane."""
    tangents = quaternion_to_matrix(torch.nn.functional.normalize(disks.quaternions, dim=-1))
    both = disks.map(lambda tensor: torch.cat([tensor, tensor]))
    drawn = torch.randn(both.log_scales.shape, generator=generator, device=disks.means.device)
    offset = torch.einsum("nij,nj->ni", tangents[..., :2].repeat(2, 1, 1), drawn * both.scales)
    smaller = both.log_scales - math.log(shrink)
    return replace(both, means=both.means + offset, log_scales=smaller)


def _useless(
    disks: AppearanceDisks, step: float, scene_scale: float, config: AppearanceConfig
) -> Bool[Tensor, "n"]:
    """Mask of the disks that are too transparent or, at this step, too large."""
    clear = disks.opacities < config.prune_opacity
    if step <= config.prune_scale_start:
        return clear
    return clear | (disks.scales.amax(1) > config.prune_scale * scene_scale)


_MOMENTS = ("exp_avg", "exp_avg_sq")


class DiskOptimizer:
    """The disks in training and their moments, which are kept when disks are added or removed."""

    def __init__(self, disks: AppearanceDisks, config: AppearanceConfig, means_rate: float):
        self.disks = disks.map(_parameter)
        """The parameters; each has its gradient."""
        rates = (
            means_rate,
            config.quaternions_rate,
            config.scales_rate,
            config.opacities_rate,
            config.sh_constant_rate,
            config.sh_rest_rate,
        )
        groups = [
            {"params": [tensor], "lr": rate}
            for tensor, rate in zip(self.disks.tensors(), rates, strict=True)
        ]
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=disks.means.is_cuda)

    def step(self, means_rate: float) -> None:
        """Take a step along the gradients, and drop them."""
        self._adam.param_groups[0]["lr"] = means_rate
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def change(self, kept: Int[Tensor, "k"], added: AppearanceDisks) -> None:
        """Keep these rows with their moments, and append disks with zero moments."""
        tensors = []
        pairs = zip(self._adam.param_groups, added.tensors(), strict=True)
        for group, new in pairs:
            (old,) = group["params"]
            tensor = _parameter(torch.cat([old.detach()[kept], new]))
            state = self._adam.state.pop(old, None)
            if state:
                for name in _MOMENTS:
                    state[name] = torch.cat([state[name][kept], torch.zeros_like(new)])
                self._adam.state[tensor] = state
            group["params"] = [tensor]
            tensors.append(tensor)
        self.disks = AppearanceDisks(*tensors)


def _parameter(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()
