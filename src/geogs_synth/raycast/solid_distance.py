"""Distances from points to solids and walls of rooms, in PyTorch."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, SolidBatch


def signed_distance(solids: SolidBatch, points: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m n"]:
    """Distance in metres from points to solids, negative inside; infinite for empty slots.

    Exact outside boxes, close to it near the others.
    """
    distance = points.new_full((*points.shape[:2], solids.kind.shape[1]), math.inf)
    kinds = ((BOX, _box_distance), (FRUSTUM, _frustum_distance), (ELLIPSOID, _ellipsoid_distance))
    for kind, measure in kinds:
        places = _places(solids, kind)
        part = solids.at(places)
        offset = points[:, :, None] - part.centre[:, None]
        local = torch.einsum("bnij,bmni->bmnj", part.rotation, offset)
        there = measure(local, part.half[:, None])
        one = part.kind[:, None] == kind
        distance[..., places] = torch.where(one, there, distance[..., places])
    return distance


def wall_distance(
    size: Float[Tensor, "b 3"], points: Float[Tensor, "b m 3"]
) -> Float[Tensor, "b m"]:
    """Distance in metres from points inside a room to its nearest face."""
    return torch.minimum(points, size[:, None] - points).amin(-1)


def _places(solids: SolidBatch, kind: int) -> Int[Tensor, "k"]:
    """Slots in which some room has a solid of a kind; all slots on a GPU."""
    n = solids.kind.shape[1]
    device = solids.kind.device
    if device.type != "cpu":  # to know how many there are, the host would have to wait
        return torch.arange(n, device=device)
    return (solids.kind == kind).any(0).nonzero()[:, 0]


def _box_distance(p: Tensor, half: Tensor) -> Tensor:
    q = p.abs() - half
    return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)


def _frustum_distance(p: Tensor, half: Tensor) -> Tensor:
    slope = (half[..., 1] - half[..., 0]) / (2 * half[..., 2])
    side = p[..., :2].norm(dim=-1) - 0.5 * (half[..., 0] + half[..., 1]) - slope * p[..., 2]
    side = side / (1 + slope * slope).sqrt()
    cap = p[..., 2].abs() - half[..., 2]
    outside = (side.clamp_min(0).square() + cap.clamp_min(0).square()).sqrt()
    return outside + torch.maximum(side, cap).clamp_max(0)


def _ellipsoid_distance(p: Tensor, half: Tensor) -> Tensor:
    k0, k1 = (p / half).norm(dim=-1), (p / half.square()).norm(dim=-1)
    return k0 * (k0 - 1) / k1.clamp_min(1e-6)
