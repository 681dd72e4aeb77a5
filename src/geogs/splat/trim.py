"""Disks cut back where they reach into free space: at an edge they overhang what they lie on."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.lie import quaternion_to_matrix
from geogs.world.disks import DiskParameters

REACH = 2.4
"""Standard deviations from its centre up to which a disk counts: it leaves 94 % of the light there
at least."""
SAMPLES = 3
"""Points from the centre to that distance, which is left out."""


def spokes(disks: DiskParameters) -> Float[Tensor, "n 2 2 s 3"]:
    """Points of disks along both tangents, forth and back, from near the centre to ``REACH``."""
    part = torch.arange(1, SAMPLES + 1, device=disks.position.device) / SAMPLES
    way = part[:, None] * torch.stack([_reach(disks), -_reach(disks)], 2)[:, :, :, None]
    return disks.position.detach()[:, None, None, None] + way


def trimmed(
    disks: DiskParameters, is_free: Bool[Tensor, "n 2 2 s"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 2"]]:
    """Positions and log-scales of disks that end half way before the first free one of ``spokes``.

    Along each tangent what is left is the new disk's reach to both sides: its centre moves away
    from the free space, and its deviation shrinks. Where nothing is free nothing changes.
    """
    beyond = is_free.int().cumsum(-1) > 0
    left = ((~beyond).sum(-1) + torch.where(beyond[..., -1], 0.5, 0.0)) / SAMPLES
    forth, back = left.unbind(-1)
    moved = ((forth - back) / 2)[..., None] * _reach(disks)
    shrunk = ((forth + back) / 2).log()
    return disks.position.detach() + moved.sum(1), disks.log_scale.detach() + shrunk


def _reach(disks: DiskParameters) -> Float[Tensor, "n 2 3"]:
    """From the centre to the end along either tangent."""
    axes = quaternion_to_matrix(disks.quaternion.detach())[..., :2].mT
    return REACH * disks.log_scale.detach().exp()[..., None] * axes
