"""Objects that stand on others, lean or hang: clutter, rows of books, wires, rotated slabs."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.clips.pieces import FloorPose, StandingPiece, boxes
from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, SolidBatch, Solids

Tops = Float[Tensor, "b t 6"]
"""Faces to stand on: centre (3), yaw, half extents (2)."""
_BOOKS = 6
"""Books in a row."""


def clutter(draw: Draw, supports: Tops, count: int) -> SolidBatch:
    """Small boxes, cones, cylinders, eggs and balls."""
    n = (len(supports), count)
    support = _choose(draw, supports, count)
    kind = draw.choose((0.45, 0.3, 0.25), *n)
    half = draw.log_uniform(0.02, 0.16, *n)[..., None] * draw.uniform(0.35, 1.0, *n, 3)
    wide = half[..., :1]
    taper = torch.where(draw.chance(0.5, *n), draw.uniform(0.4, 1.2, *n), 1.0)[..., None]
    cone = torch.cat([wide, wide * taper, half[..., 2:]], -1)
    half = torch.where((kind == FRUSTUM)[..., None], cone, half)
    offset = draw.uniform(-0.9, 0.9, *n, 2) * support[..., 4:]
    centre = _on(support, offset) + torch.nn.functional.pad(half[..., 2:], (2, 0))
    return Solids(kind, about_z(draw.uniform(-3.15, 3.15, *n)), centre, half)


def books(draw: Draw, supports: Tops, rows: int) -> StandingPiece:
    """Rows of upright books of similar heights."""
    n = (len(supports), rows)
    support = _choose(draw, supports, rows)
    thick = draw.log_uniform(0.008, 0.03, *n, _BOOKS)
    depth, tall = draw.uniform(0.06, 0.1, *n, 1), draw.uniform(0.08, 0.13, *n, 1)
    tall = tall * draw.uniform(0.75, 1.2, *n, _BOOKS)
    x = 2 * thick.cumsum(-1) - thick
    x = x - x.mean(-1, keepdim=True)
    column = zip(*(t.unbind(-1) for t in (x, tall, thick)), strict=True)
    piece = boxes(*((u, 0 * u, h, t, depth[..., 0], h) for u, h, t in column))
    room = (support[..., 4:] - 0.12).clamp_min(0)
    position = _on(support, draw.uniform(-1, 1, *n, 2) * room)
    return piece, FloorPose(position, support[..., 3])


def wires(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> SolidBatch:
    """Thin rods: upright, along a wall, or of any direction."""
    n = (len(size), count)
    radius = draw.log_uniform(0.004, 0.025, *n)
    half = torch.stack([radius, radius, draw.log_uniform(0.15, 1.4, *n)], -1)
    upright = torch.eye(3).expand(*n, 3, 3)
    flat = about_z(draw.integers(2, *n) * (torch.pi / 2)) @ upright[..., [2, 0, 1], :]
    way = draw.choose((0.5, 0.35, 0.15), *n)[..., None, None]
    rotation = torch.where(way == 0, upright, torch.where(way == 1, flat, draw.rotation(*n)))
    return Solids(torch.full(n, FRUSTUM), rotation, _anywhere(draw, size, count), half)


def slabs(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> SolidBatch:
    """Randomly rotated slabs, boxes and ellipsoids, in the air too."""
    n = (len(size), count)
    half = draw.log_uniform(0.05, 0.5, *n, 3)
    half[..., 2] = half[..., 2] * draw.log_uniform(0.03, 1.0, *n)
    kind = torch.where(draw.chance(0.3, *n), ELLIPSOID, BOX)
    return Solids(kind, draw.rotation(*n), _anywhere(draw, size, count), half.clamp_min(0.004))


def floor(size: Float[Tensor, "b 3"]) -> Tops:
    """The floor as a face to stand on."""
    middle, zero = 0.5 * size[:, :2], torch.zeros(len(size), 2)
    return torch.cat([middle, zero, middle], -1)[:, None]


def _choose(draw: Draw, supports: Tops, count: int) -> Float[Tensor, "b k 6"]:
    n = (len(supports), count)
    return supports.gather(1, draw.integers(supports.shape[1], *n)[..., None].expand(*n, 6))


def _on(support: Float[Tensor, "b k 6"], offset: Float[Tensor, "b k 2"]) -> Float[Tensor, "b k 3"]:
    """Points at an offset from the centres of faces."""
    R = about_z(support[..., 3])[..., :2, :2]
    xy = support[..., :2] + torch.einsum("bkij,bkj->bki", R, offset)
    return torch.cat([xy, support[..., 2:3]], -1)


def _anywhere(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> Float[Tensor, "b k 3"]:
    return draw.uniform(0.03, 0.97, len(size), count, 3) * size[:, None]
