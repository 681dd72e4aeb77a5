"""Which keyframes a camera would see again from a given pose."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.world.keyframes import Keyframe

MAX_FACING = 12
"""Keyframes that face most nearly the same way."""
MAX_VISIBLE = 2
"""Keyframes that are worth a measurement."""
MIN_OVERLAP = 0.15
"""Fraction of a keyframe's cells that must have known depth and fall into the image."""


def visible_keyframes(keyframes: Sequence[Keyframe], T_cw: Float[Tensor, "4 4"]) -> list[Keyframe]:
    """The keyframes most of whose known depth falls into the image of a camera, best first."""
    if not keyframes:
        return []
    axis = T_cw[2, :3]
    facing = sorted(keyframes, key=lambda k: -float(k.T_cw[2, :3] @ axis))[:MAX_FACING]
    grid = facing[0].grid
    there, _ = grid_fields(grid).reproject(facing, [T_cw] * len(facing))
    known = torch.stack([k.has_known_depth for k in facing])
    seen = (grid.inside(there) & known).float().mean(1).tolist()
    ranked = sorted(zip(seen, facing, strict=True), key=lambda pair: -pair[0])
    return [k for fraction, k in ranked[:MAX_VISIBLE] if fraction >= MIN_OVERLAP]
