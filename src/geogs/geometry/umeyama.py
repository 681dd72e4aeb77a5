"""Similarity between two point sets in closed form."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.errors import GeogsError


def umeyama(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], with_scale: bool = True
) -> tuple[Float[Tensor, ""], Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Return least-squares ``scale, R, t`` with ``target = scale R source + t`` (Umeyama 1991).

    Raises GeogsError if there are fewer than three points or they lie on one point or line, where
    the rotation is not determined.
    """
    if len(source) < 3:
        raise GeogsError(f"A similarity needs three points, {len(source)} were given.")
    w = torch.ones_like(source[:, :1]) / len(source)
    mean_s, mean_t = (w * source).sum(0), (w * target).sum(0)
    s, t = source - mean_s, target - mean_t
    variance = (w * s * s).sum()
    u, d, vt = torch.linalg.svd(t.mT @ (w * s))
    if not torch.isfinite(d).all() or d[1] <= 1e-12 * torch.clamp(d[0], min=1e-300):
        raise GeogsError("The points lie on one line, so their alignment is not determined.")
    sign = torch.ones_like(d)
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    R = (u * sign) @ vt
    scale = (d * sign).sum() / variance if with_scale else torch.ones_like(variance)
    return scale, R, mean_t - scale * R @ mean_s
