"""Points beside a surface in whose place some views see what lies far behind."""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.carve import (
    VOTE_CONFIDENCE,
    VOTE_FREE_VIEWS,
    VOTE_SUPPORT,
    VOTE_VIOLATION,
)
from geogs.depth.depth_view import PosedDepth
from geogs.geometry.camera import Camera


def past_silhouettes(
    centres: Float[Tensor, "n 3"],
    points: Float[Tensor, "n m 3"],
    views: Iterable[PosedDepth],
    camera: Camera,
) -> Bool[Tensor, "n m"]:
    """Which world points lie in free space, beside centres that lie on what stands before it.

    A view says so that sees the centre on its surface, sure or not, no farther than
    ``VOTE_VIOLATION`` from it, and the point that far in front of a sure depth. So its silhouette
    runs between the two. As for whole points (:mod:`geogs.depth.carve`), two views have to say it,
    and more than see the point on a surface of theirs.
    """
    n, m = points.shape[:2]
    free = torch.zeros(n, m, dtype=torch.int32, device=points.device)
    surface = torch.zeros_like(free)
    every = torch.cat([centres[:, None], points], 1).reshape(-1, 3)
    for view in views:
        ratio, confidence = (x.reshape(n, m + 1) for x in _looked_up(every, view, camera))
        beside, sure = ratio[:, 1:], confidence[:, 1:] > VOTE_CONFIDENCE
        on_surface = (ratio[:, :1] - 1).abs() < VOTE_VIOLATION
        free += sure & on_surface & (beside < 1 - VOTE_VIOLATION)
        surface += sure & ((beside - 1).abs() < VOTE_SUPPORT)
    return (free >= VOTE_FREE_VIEWS) & (free > surface)


def _looked_up(
    points: Float[Tensor, "p 3"], view: PosedDepth, camera: Camera
) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
    """Each point's z over the depth that a view has there, and its confidence; 0, 0 where unseen.

    As ``carve.look_up``, on any device.
    """
    depth, confidence = view.depth.depth, view.depth.confidence
    T_cw = torch.from_numpy(view.T_cw).to(points)
    x, y, z = (points @ T_cw[:3, :3].T + T_cw[:3, 3]).unbind(-1)
    front = z > 1e-4
    safe = torch.where(front, z, 1.0)
    u = (camera.fx * x / safe + camera.cx + 0.5).floor()
    v = (camera.fy * y / safe + camera.cy + 0.5).floor()
    height, width = depth.shape
    seen = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    pixel = torch.where(seen, v * width + u, 0.0).long()
    there = depth.flatten()[pixel]
    seen &= there > 0
    ratio = torch.where(seen, z / there.clamp(min=1e-9), 0.0)
    return ratio, torch.where(seen, confidence.flatten()[pixel], 0.0)
