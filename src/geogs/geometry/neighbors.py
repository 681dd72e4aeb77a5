"""k nearest neighbours."""

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.gpu.kernels import kernels_for

MAX_GPU_NEIGHBORS = 32
"""Most neighbours on a GPU: each lane of a warp holds one."""
_SOURCE = Path(__file__).parent / "cuda" / "neighbors.cu"
_QUERIES_PER_BLOCK = 8


def nearest_neighbors(
    queries: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"], k: int
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Return distances and indices of the ``min(k, m)`` nearest points, nearest first.

    A query that is itself one of the points finds itself first, at distance zero. Exact: a k-d
    tree on the CPU; on a GPU all pairs in float32 without waiting for the device (so points that
    differ in distance by less than 1e-7 of it may be swapped), for up to 32 neighbours.
    """
    k = min(k, len(points))
    if queries.device.type == "cuda" and 0 < k <= MAX_GPU_NEIGHBORS:
        indices = all_pairs_neighbors(queries, points, k)
        offset = points[indices] - queries.to(points.dtype)[:, None]
        return offset.norm(dim=-1).to(queries.dtype), indices
    from scipy.spatial import cKDTree

    tree = cKDTree(points.detach().cpu().numpy())
    distances, indices = tree.query(queries.detach().cpu().numpy(), k=k, workers=-1)
    d = torch.as_tensor(distances.reshape(-1, k), dtype=queries.dtype, device=queries.device)
    return d, torch.as_tensor(indices.reshape(-1, k), device=queries.device)


def all_pairs_neighbors(
    queries: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"], k: int
) -> Int[Tensor, "n k"]:
    """Find the k nearest points by the CUDA kernel, nearest first; 1 <= k <= min(m, 32)."""
    if not 1 <= k <= min(len(points), MAX_GPU_NEIGHBORS):
        raise ValueError(f"{k} neighbours of {len(points)} points")
    kernel = kernels_for(_SOURCE, queries.device)["nearest_neighbors"]
    n = len(queries)
    indices = torch.empty((n, k), dtype=torch.int64, device=queries.device)
    blocks = (n + _QUERIES_PER_BLOCK - 1) // _QUERIES_PER_BLOCK
    near = queries.detach().float().contiguous()
    far = points.detach().float().contiguous()
    kernel(blocks, 32 * _QUERIES_PER_BLOCK, near, far, n, len(points), k, indices)
    return indices
