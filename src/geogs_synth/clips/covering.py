"""Rooms whose walls repeat one pattern, and rooms with next to no texture."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from geogs_synth.draw import Draw
from geogs_synth.scene.rooms import Surfaces

_PERIOD = (0.06, 0.7)
"""Width of a pattern, metres."""


def papered(draw: Draw, surfaces: Surfaces, which: Bool[Tensor, "b"]) -> Surfaces:
    """The walls, and half of the floors, of these rooms repeat one image exactly, often."""
    b = len(which)
    half = torch.tensor([True] * 4 + [False, False]).expand(b, 6) & which[:, None]
    floor = torch.tensor([False] * 4 + [True, False]).expand(b, 6)
    chosen = half | (floor & (which & draw.chance(0.5, b))[:, None])
    chosen = torch.nn.functional.pad(chosen, (0, surfaces.contrast.shape[1] - 6))
    scale = surfaces.matrix[..., 0].norm(dim=-1)
    wanted = 1 / draw.log_uniform(*_PERIOD, b, 1)
    matrix = surfaces.matrix * (wanted / scale)[..., None, None]
    contrast = draw.log_uniform(0.15, 1.2, b, 1).expand_as(scale)
    return replace(
        surfaces,
        matrix=torch.where(chosen[..., None, None], matrix, surfaces.matrix),
        contrast=torch.where(chosen, contrast, surfaces.contrast),
        detail=torch.where(chosen, 0.0, surfaces.detail),
    )


def bared(draw: Draw, surfaces: Surfaces, which: Bool[Tensor, "b"]) -> Surfaces:
    """All of the rooms' faces and most solids of these rooms are of one colour, or nearly."""
    b, s = surfaces.contrast.shape
    chosen = draw.chance(0.75, b, s)
    chosen[:, :6] = draw.chance(0.95, b, 6)
    chosen &= which[:, None]
    faint = draw.chance(0.5, b, s) * draw.log_uniform(0.003, 0.04, b, s)
    return replace(
        surfaces,
        contrast=torch.where(chosen, faint, surfaces.contrast),
        detail=torch.where(chosen, 0.3 * faint, surfaces.detail),
        mirror=torch.where(chosen, 0.0, surfaces.mirror),
    )
