"""Rays against batches of rooms on the CPU.

A ray is ``origin + t * direction`` with any length of the direction. Solids are convex, and rays
enter them only from outside, so each has at most one hit.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.raycast.solid_kernels import BoundedSolids, closest_hits
from geogs_synth.scene.solids import SolidBatch

_TINY = 1e-9


@dataclass(frozen=True)
class Hit:
    """Hits of rays with a room or a solid in it."""

    t: Float[Tensor, "b m"]
    """Ray parameter, in units of the direction."""
    solid: Int[Tensor, "b m"]
    """Index of the solid; -1 for the room itself."""


def closest_hit(
    size: Float[Tensor, "b 3"],
    solids: SolidBatch,
    origin: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
) -> Hit:
    """First hit of each ray from inside a room."""
    d = torch.where(direction.abs() < _TINY, _TINY, direction)
    leaves = (torch.where(d > 0, size[:, None] - origin, -origin) / d).amin(-1)
    return _first(solids, origin, direction, leaves)


def occluded(
    solids: SolidBatch,
    origin: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
    end: Float[Tensor, "b m"],
) -> Bool[Tensor, "b m"]:
    """Whether a solid is hit before ``t = end``."""
    return _first(solids, origin, direction, end).solid >= 0


def _first(
    solids: SolidBatch,
    origin: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
    end: Float[Tensor, "b m"],
) -> Hit:
    """First hit with a solid before ``end``, or -1 there."""
    t = end.double().clone()
    solid = torch.full(end.shape, -1)
    radius = solids.bounding_half.norm(dim=-1)
    numbers = (solids.half, solids.rotation, solids.centre, radius, origin, direction)
    *shapes, start, ray = (x.double().contiguous().numpy() for x in numbers)
    kind = solids.kind.contiguous().numpy()
    for k in range(len(t)):
        bounded = BoundedSolids(kind[k], *(x[k] for x in shapes))
        closest_hits(bounded, start[k], ray[k], t[k].numpy(), solid[k].numpy())
    return Hit(t.to(origin), solid)
