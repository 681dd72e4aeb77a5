"""Normals of a depth map in logarithms, differentiable and in batches."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def normals_of(
    log_depth: Float[Tensor, "b h w"], rays: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Unit normals that face the camera, from central differences; one-sided at the border.

    The tangent along x of the surface z(x, y) ray is z (dray/dx + dlog z/dx ray), so that the unit
    of depth does not matter; ``rays`` are K^-1 (x, y, 1).
    """
    padded = functional.pad(log_depth[:, None], (1, 1, 1, 1), mode="replicate")
    across = _halved(padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2], 3)
    down = _halved(padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1], 2)
    zero = torch.zeros_like(rays[:, :1])
    dx = (rays[:, :1, :, 1:] - rays[:, :1, :, :-1]).mean((2, 3), keepdim=True) + zero
    dy = (rays[:, 1:2, 1:] - rays[:, 1:2, :-1]).mean((2, 3), keepdim=True) + zero
    along_x = torch.cat([dx, zero, zero], 1) + across * rays
    along_y = torch.cat([zero, dy, zero], 1) + down * rays
    normal = torch.linalg.cross(along_y, along_x, dim=1)
    return functional.normalize(normal, dim=1, eps=1e-12)


def _halved(difference: Tensor, dim: int) -> Tensor:
    """Central differences per step; those of the border span one step only."""
    factor = torch.full((difference.shape[dim],), 0.5, device=difference.device)
    factor[:1].fill_(1.0)  # no number may come from the host: a CUDA graph records this
    factor[-1:].fill_(1.0)
    shape = [1] * difference.dim()
    shape[dim] = -1
    return difference * factor.view(shape)
