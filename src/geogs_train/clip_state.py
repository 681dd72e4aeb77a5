"""Clips as the bundle adjustment sees them: which views are matched, true and blind states."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.world.grid import OFFSET, STRIDE
from geogs_train.bundle import ClipEdges, ClipState


def neighbour_edges(views: int, reach: int, device: torch.device | str = "cpu") -> ClipEdges:
    """All ordered pairs of views at most ``reach`` apart."""
    pairs = [(i, j) for i in range(views) for j in range(views) if 0 < abs(i - j) <= reach]
    return ClipEdges(*torch.tensor(pairs, device=device).unbind(1))


def true_state(T_cw: Float[Tensor, "b v 4 4"], depth: Float[Tensor, "b v h w"]) -> ClipState:
    """The truth at the cells, at the scale that makes the median inverse depth of a clip one.

    That is where a tracker's depths start, so that one is as good a guess as any.
    """
    d = 1 / depth[..., OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].flatten(2)
    scale = d.flatten(1).median(1).values[:, None, None]
    T = T_cw.clone()
    T[..., :3, 3] *= scale.to(T)
    return ClipState(T, d / scale)


def blind_start(truth: ClipState, known: int = 2) -> ClipState:
    """The first ``known`` poses as they are, the others like the last of them; unit depth."""
    T = truth.T_cw
    held = T[:, known - 1 : known].expand(-1, T.shape[1] - known, -1, -1)
    return ClipState(torch.cat([T[:, :known], held], 1), torch.ones_like(truth.inverse_depth))
