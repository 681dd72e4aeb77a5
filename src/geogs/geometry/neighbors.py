"""k nearest neighbours."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def nearest_neighbors(
    queries: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"], k: int
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Distances and indices of the ``min(k, m)`` nearest points, nearest first (exact, k-d tree).

    A query that is itself one of the points finds itself first, at distance zero.
    """
    from scipy.spatial import cKDTree

    k = min(k, len(points))
    tree = cKDTree(points.detach().cpu().numpy())
    distances, indices = tree.query(queries.detach().cpu().numpy(), k=k, workers=-1)
    d = torch.as_tensor(distances.reshape(-1, k), dtype=queries.dtype, device=queries.device)
    return d, torch.as_tensor(indices.reshape(-1, k), device=queries.device)
