"""Depth discontinuities between surfaces, and slopes of inverse depth within them."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

JUMP = 0.04
"""Least jump of depth, as a fraction of the farther depth: 1 - near / far."""


class DepthJumps(NamedTuple):
    """Pixels at either end of a jump along a row or a column."""

    near: Bool[Tensor, "h w"]
    """Ends on the nearer surface."""
    far: Bool[Tensor, "h w"]
    """Ends on the farther surface."""

    def around(self, reach: int) -> Bool[Tensor, "h w"]:
        """Return the pixels at most ``reach`` rows and columns from an end."""
        return widened(self.near | self.far, reach)


def depth_jumps(depth: Float[Tensor, "h w"]) -> DepthJumps:
    """Find jumps of a depth map that no plane explains.

    Inverse depth is linear along a plane: the step between two pixels has to exceed ``JUMP`` after
    subtracting the slope before it, and also the slope after it. Pixels without depth (0 or less)
    end no jump.
    """
    inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-9), torch.nan)
    across = _ends(inverse)
    down = DepthJumps(*(ends.mT for ends in _ends(inverse.mT)))
    return DepthJumps(across.near | down.near, across.far | down.far)


def _ends(inverse: Float[Tensor, "h w"]) -> DepthJumps:
    """Find jumps along rows; comparisons with unknown values are false."""
    step = inverse.diff(dim=1)
    before = F.pad(step[:, :-1], (1, 0), value=torch.inf)
    after = F.pad(step[:, 1:], (0, 1), value=torch.inf)
    left = torch.minimum(torch.minimum((step - before).abs(), (step - after).abs()), step.abs())
    jump = left > JUMP * torch.maximum(inverse[:, 1:], inverse[:, :-1])
    rises = jump & (step > 0)
    falls = jump & (step < 0)
    return DepthJumps(
        F.pad(rises, (1, 0)) | F.pad(falls, (0, 1)), F.pad(rises, (0, 1)) | F.pad(falls, (1, 0))
    )


def widened(mask: Bool[Tensor, "h w"], reach: int) -> Bool[Tensor, "h w"]:
    """Dilate a mask by ``reach`` rows and columns."""
    if reach < 1:
        return mask
    side = 2 * reach + 1
    if mask.is_cuda:
        return F.max_pool2d(mask[None, None].float(), side, 1, reach)[0, 0] > 0
    # OpenCV takes a fiftieth of the time of a pooling on the CPU.
    wide = cv2.dilate(mask.to(torch.uint8).numpy(), np.ones((side, side), np.uint8))
    return torch.from_numpy(wide) > 0


def minmod_slopes(
    inverse: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Return differences of inverse depth per pixel to the right and down, not across jumps.

    Each is the smaller of the differences to the two neighbours, zero where their signs differ or a
    neighbour is not valid (minmod).
    """
    right, down = (_minmod(*maps) for maps in ((inverse, valid), (inverse.mT, valid.mT)))
    return right, down.mT


def _minmod(inverse: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    step = torch.where(valid[:, 1:] & valid[:, :-1], inverse.diff(dim=1), 0.0)
    before, after = F.pad(step, (1, 0)), F.pad(step, (0, 1))
    smaller = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(before * after > 0, smaller, 0.0)
