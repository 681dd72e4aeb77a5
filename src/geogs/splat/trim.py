"""Disks cut back where they reach into free space: at an edge they overhang what they lie on."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.lie import quaternion_to_matrix
from geogs.world.disks import DiskParameters

REACH = 3.0
"""Standard deviations from its centre where a disk ends: it leaves 99 % of the light there."""
SAMPLES = 4
"""Points between the centre and an end."""


def spokes(disks: DiskParameters) -> Float[Tensor, "n 2 2 s 3"]:
    """Points of disks along both tangents, forth and back, from the centre towards the ends."""
    part = torch.arange(1, SAMPLES + 1, device=disks.position.device) / (SAMPLES + 1)
    way = part[:, None] * torch.stack([_reach(disks), -_reach(disks)], 2)[:, :, :, None]
    return disks.position.detach()[:, None, None, None] + way


def trimmed(
    disks: DiskParameters, is_free: Bool[Tensor, "n 2 2 s"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 2"]]:
    """Positions and log-scales of disks that end at the first free one of their ``spokes``.

    Along each tangent the centre moves away from the free space, and the deviation shrinks, so that
    the other end stays where it is. Where nothing is free nothing changes.
    """
    left = ((is_free.int().cumsum(-1) == 0).sum(-1) + 1) / (SAMPLES + 1)
    forth, back = left.unbind(-1)
    moved = ((forth - back) / 2)[..., None] * _reach(disks)
    shrunk = ((forth + back) / 2).log()
    return disks.position.detach() + moved.sum(1), disks.log_scale.detach() + shrunk


def _reach(disks: DiskParameters) -> Float[Tensor, "n 2 3"]:
    """From the centre to the end along either tangent."""
    axes = quaternion_to_matrix(disks.quaternion.detach())[..., :2].mT
    return REACH * disks.log_scale.detach().exp()[..., None] * axes
