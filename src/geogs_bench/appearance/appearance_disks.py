"""The disks of the baseline: trainable shape and colour."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

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
    n, device = len(points), points.device
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
