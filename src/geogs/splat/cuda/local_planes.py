"""Planes through neighbourhoods of points, by one kernel without the host or a batched eigh."""

from pathlib import Path

from jaxtyping import Float, Int
from torch import Tensor

from geogs.gpu.kernels import kernels_for

_SOURCE = Path(__file__).with_suffix(".cu")
_BLOCK = 64


def principal_planes(
    points: Float[Tensor, "m 3"], neighbours: Int[Tensor, "n k"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Normal, tangent, planarity and spacing of each neighbourhood; see ``LocalPlane``.

    ``neighbours`` are indices (int64) of ``points`` (float32), nearest first, beginning with the
    point itself. Computed in float64: Jacobi's method on the 3 x 3 scatter matrices.
    """
    n, k = neighbours.shape
    normal, tangent = points.new_empty(n, 3), points.new_empty(n, 3)
    planarity, spacing = points.new_empty(n), points.new_empty(n)
    kernel = kernels_for(_SOURCE, points.device)["local_planes"]
    blocks = (n + _BLOCK - 1) // _BLOCK
    kernel(blocks, _BLOCK, points, neighbours, n, k, normal, tangent, planarity, spacing)
    return normal, tangent, planarity, spacing
