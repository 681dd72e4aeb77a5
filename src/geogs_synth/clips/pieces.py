"""Pieces of furniture as groups of boxes, cone frustums and ellipsoids with random sizes.

Each is built in a frame on the floor: x along the wall behind it, y into the room, z up, with the
piece centred on x = y = 0. All are drawn for b rooms and k pieces of a kind at once.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.batch import where
from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, SolidBatch, Solids, upright

BOARDS, LEAVES = 5, 7
"""Numbers of boards of a shelf and of leaves of a plant."""
Numbers = Float[Tensor, "b k"]


@dataclass(frozen=True)
class FloorPose:
    """Poses of k pieces on the floor."""

    position: Float[Tensor, "b k 3"]
    """World, metres."""
    yaw: Float[Tensor, "b k"]
    """Radians."""


StandingPiece = tuple[SolidBatch, FloorPose]
"""k pieces of p solids in the frame of their piece (b k p), and their poses."""


def stand(
    draw: Draw, size: Float[Tensor, "b 3"], half: Float[Tensor, "b k 2"], at_wall: float
) -> FloorPose:
    """Poses on the floor: backs to a wall, or anywhere with any yaw."""
    b, k = half.shape[:2]
    wall = draw.integers(4, b, k)
    along, across = _lengths(size, wall)
    x = draw.uniform(-0.5, 0.5, b, k) * (along - 2 * half[..., 0]).clamp_min(0)
    y = -0.5 * across + half[..., 1] + draw.uniform(0, 0.03, b, k)
    back = draw.chance(at_wall, b, k)
    yaw = torch.where(back, wall * (torch.pi / 2), draw.uniform(-3.15, 3.15, b, k))
    reach = half.norm(dim=-1)[..., None]
    free = draw.uniform(-0.5, 0.5, b, k, 2) * (size[:, None, :2] - 2 * reach).clamp_min(0)
    c, s = yaw.cos(), yaw.sin()
    fixed = torch.stack([c * x - s * y, s * x + c * y], -1)
    centre = torch.where(back[..., None], fixed, free) + 0.5 * size[:, None, :2]
    return FloorPose(torch.cat([centre, torch.zeros_like(centre[..., :1])], -1), yaw)


def _lengths(size: Float[Tensor, "b 3"], wall: Int[Tensor, "b k"]) -> tuple[Numbers, Numbers]:
    """Length of the room along and across walls (0 and 2 run along x)."""
    odd = wall % 2 == 1
    return (
        torch.where(odd, size[:, 1:2], size[:, :1]),
        torch.where(odd, size[:, :1], size[:, 1:2]),
    )


def boxes(*rows: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]) -> SolidBatch:
    """Boxes from centre x, y, z and half extents x, y, z."""
    numbers = torch.stack([torch.stack(torch.broadcast_tensors(*r), -1) for r in rows], -2)
    return upright(torch.full(numbers.shape[:-1], BOX), numbers[..., :3], numbers[..., 3:])


def cupboards(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Boxes of all sizes on the floor: cupboards, chests, beds, pillars, a few round ones."""
    n = (len(size), count)
    w, d, h = (draw.log_uniform(*r, *n) for r in ((0.12, 0.9), (0.12, 0.42), (0.1, 1.1)))
    bed = draw.chance(0.15, *n)
    w, d, h = (torch.where(bed, x, y) for x, y in ((w + 0.5, w), (d + 0.4, d), (0.15 + 0.2 * h, h)))
    zero = torch.zeros_like(w)
    piece = boxes((zero, zero, h, w, d, h))
    round_ = draw.chance(0.12, *n)
    barrel = torch.stack([d, d * draw.uniform(0.5, 1.2, *n), h], -1)[..., None, :]
    cylinder = replace(piece, kind=torch.full_like(piece.kind, FRUSTUM), half=barrel)
    piece = where(round_, cylinder, piece)
    return piece, stand(draw, size, torch.stack([w, d], -1), 0.7)


def tables(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """A top on four legs: tables, desks, stools."""
    n = (len(size), count)
    w, d = draw.log_uniform(0.2, 0.95, *n), draw.log_uniform(0.2, 0.5, *n)
    thick, height = draw.log_uniform(0.008, 0.04, *n), draw.uniform(0.35, 1.0, *n)
    piece = _with_legs(draw, boxes((0 * w, 0 * w, height, w, d, thick)), w, d, height - thick)
    return piece, stand(draw, size, torch.stack([w, d], -1), 0.4)


def chairs(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """A seat with a back on four legs."""
    n = (len(size), count)
    w, height = draw.uniform(0.19, 0.3, *n), draw.uniform(0.38, 0.55, *n)
    back, thick = draw.uniform(0.15, 0.4, *n), draw.log_uniform(0.01, 0.05, *n)
    piece = boxes(
        (0 * w, 0 * w, height, w, w, thick),
        (0 * w, -w, height + back, w, thick, back),
    )
    piece = _with_legs(draw, piece, w, w, height - thick)
    return piece, stand(draw, size, torch.stack([w, w], -1), 0.2)


def _with_legs(
    draw: Draw, piece: SolidBatch, w: Numbers, d: Numbers, height: Numbers
) -> SolidBatch:
    thick = draw.log_uniform(0.008, 0.04, *w.shape)
    x, y, z = w - thick, d - thick, 0.5 * height
    legs = boxes(*((sx * x, sy * y, z, thick, thick, z) for sx in (-1, 1) for sy in (-1, 1)))
    kind = torch.where(draw.chance(0.4, *w.shape)[..., None], FRUSTUM, legs.kind)
    return Solids.join([piece, replace(legs, kind=kind)])


def sofas(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """A seat between two arms and a back."""
    n = (len(size), count)
    w, d = draw.uniform(0.4, 1.1, *n), draw.uniform(0.35, 0.5, *n)
    seat, back = draw.uniform(0.16, 0.24, *n), draw.uniform(0.32, 0.5, *n)
    arm, thick = draw.uniform(0.25, 0.34, *n), draw.uniform(0.06, 0.13, *n)
    piece = boxes(
        (0 * w, 0 * w, seat, w, d, seat),
        (0 * w, thick - d, back, w, thick, back),
        (w + thick, 0 * w, arm, thick, d, arm),
        (-w - thick, 0 * w, arm, thick, d, arm),
    )
    return piece, stand(draw, size, torch.stack([w + 2 * thick, d], -1), 0.7)


def shelves(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Boards between two sides."""
    n = (len(size), count)
    w, d = draw.uniform(0.3, 0.8, *n), draw.uniform(0.1, 0.22, *n)
    pitch, thick = draw.uniform(0.22, 0.45, *n), draw.uniform(0.006, 0.015, *n)
    boards = [(0 * w, 0 * w, (k + 0.2) * pitch, w, d, thick) for k in range(BOARDS)]
    tall = 0.5 * (BOARDS - 0.8) * pitch
    sides = [(s * w, 0 * w, tall, thick, d, tall) for s in (-1, 1)]
    return boxes(*boards, *sides), stand(draw, size, torch.stack([w, d], -1), 0.85)


def lamps(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Shades below the ceiling."""
    n = (len(size), count)
    low, high = draw.uniform(0.05, 0.3, *n), draw.uniform(0.02, 0.2, *n)
    tall, drop = draw.uniform(0.03, 0.2, *n), draw.uniform(0.05, 0.7, *n)
    z = size[:, 2:] - drop - tall
    piece = boxes((0 * low, 0 * low, z, low, high, tall))
    piece = replace(piece, kind=torch.full_like(piece.kind, FRUSTUM))
    return piece, stand(draw, size, low[..., None].expand(*n, 2), 0.0)


def pictures(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Thin boxes on a wall, a frame and a panel: pictures, windows, doors, switches."""
    n = (len(size), count)
    w, h = draw.log_uniform(0.05, 0.8, *n), draw.log_uniform(0.05, 0.8, *n)
    door = draw.chance(0.15, *n)
    w, h = torch.where(door, 0.3 + 0.2 * w, w), torch.where(door, 1.0, h)
    thick, rim = draw.log_uniform(0.003, 0.03, *n), draw.log_uniform(0.004, 0.06, *n)
    free = (size[:, 2:] - 2 * h - 0.1).clamp_min(0)
    z = torch.where(door, h, h + 0.05 + draw.uniform(0.2, 1.0, *n) * free)
    piece = boxes((0 * w, 0 * w, z, w, 1.3 * thick, h), (0 * w, 0 * w, z, w + rim, thick, h + rim))
    return piece, stand(draw, size, torch.stack([w + rim, thick], -1), 1.0)


def skirting(draw: Draw, size: Float[Tensor, "b 3"]) -> StandingPiece:
    """A board along the foot of all four walls, in one piece."""
    b = len(size)
    thick, tall = draw.log_uniform(0.004, 0.012, b, 1), draw.log_uniform(0.02, 0.08, b, 1)
    x, y = 0.5 * size[:, :1], 0.5 * size[:, 1:2]
    rows = [(s * x, 0 * y, tall, thick, y, tall) for s in (-1, 1)]
    rows += [(0 * x, s * y, tall, x, thick, tall) for s in (-1, 1)]
    position = torch.stack([x, y, 0 * x], -1)
    return boxes(*rows), FloorPose(position, 0 * x)


def plants(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Randomly rotated flat ellipsoids above a pot."""
    n = (len(size), count)
    radius, tall = draw.uniform(0.06, 0.18, *n), draw.uniform(0.06, 0.2, *n)
    pot = torch.stack([0.8 * radius, radius, tall], -1)[:, :, None]
    half = draw.log_uniform(0.05, 0.22, *n, LEAVES, 3) * torch.tensor([1.0, 0.5, 0.12])
    spread = draw.normal(1.0, *n, LEAVES, 3) * torch.tensor([0.12, 0.12, 0.15])
    centre = spread + (2 * tall + 0.2)[..., None, None] * torch.tensor([0.0, 0.0, 1.0])
    foot = torch.stack([0 * tall, 0 * tall, tall], -1)[:, :, None]
    leaves = Solids(torch.full((*n, LEAVES), ELLIPSOID), draw.rotation(*n, LEAVES), centre, half)
    piece = Solids.join([upright(torch.full((*n, 1), FRUSTUM), foot, pot), leaves])
    return piece, stand(draw, size, radius[..., None].expand(*n, 2), 0.3)


def tops(placed: StandingPiece, which: int) -> Float[Tensor, "b k 6"]:
    """Upper face of a solid of each piece: centre (3), yaw, half extents (2)."""
    piece, place = placed
    rotation = about_z(place.yaw)
    centre = torch.einsum("bkij,bkj->bki", rotation, piece.centre[:, :, which]) + place.position
    lift = torch.nn.functional.pad(piece.half[:, :, which, 2:], (2, 0))
    return torch.cat([centre + lift, place.yaw[..., None], piece.half[:, :, which, :2]], -1)
