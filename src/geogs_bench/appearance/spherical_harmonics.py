"""Real spherical harmonics up to degree 3, as Gaussian splatting uses them for colour."""

import torch
from jaxtyping import Float
from torch import Tensor

# sqrt(1 / 4 pi), sqrt(3 / 4 pi), sqrt(15 / 4 pi), ...: norms of the real basis functions. The
# signs follow the Condon-Shortley phase, which splatting's coefficients include.
_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277,
)  # fmt: skip


def coefficient_count(degree: int) -> int:
    """Basis functions of all degrees up to ``degree``."""
    return (degree + 1) ** 2


def constant_from_colour(colour: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """The coefficient of degree 0 that shows an RGB colour in [0, 1] from everywhere."""
    return (colour - 0.5) / _C0


def basis(degree: int, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """Values of the basis functions in unit directions."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, _C0)]
    if degree > 0:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        a, b, c = _C2
        values += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _C3
        values += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, -1)


def view_colours(
    degree: int, directions: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"]
) -> Float[Tensor, "n 3"]:
    """RGB, at least 0, of disks seen along ``directions`` (camera to disk, any length)."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    used = coefficients[:, : coefficient_count(degree)]
    return (torch.einsum("nk,nkc->nc", basis(degree, unit), used) + 0.5).clamp(min=0)
