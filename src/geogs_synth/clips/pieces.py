"""Furniture and loose objects as boxes, cone frustums and ellipsoids with random sizes.

A piece of furniture is built in a frame on the floor: x along the wall behind it, y into the room,
z up, with the piece centred on x = y = 0. All are drawn for b rooms and k of a kind at once.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.batch import where
from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, SolidBatch, Solids, upright

BOARDS, LEAVES = 5, 7
"""Numbers of boards of a shelf and of leaves of a plant."""
Numbers = Float[Tensor, "b k"]
Tops = Float[Tensor, "b t 6"]
"""Faces to stand on: centre (3), yaw, half extents (2)."""
_BOOKS = 6
"""Books in a row."""
BALUSTERS, BARS, SEGMENTS, TWIGS = 12, 5, 5, 12
"""Numbers of parts of a railing, of a lattice in each direction, of a cable, of a bush."""


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
    # Walls 0 and 2 run along x.
    odd = wall % 2 == 1
    along = torch.where(odd, size[:, 1:2], size[:, :1])
    across = torch.where(odd, size[:, :1], size[:, 1:2])
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
    w = draw.log_uniform(0.2, 0.95, *n)
    d = draw.log_uniform(0.2, 0.5, *n)
    thick = draw.log_uniform(0.008, 0.04, *n)
    height = draw.uniform(0.35, 1.0, *n)
    piece = _with_legs(draw, boxes((0 * w, 0 * w, height, w, d, thick)), w, d, height - thick)
    return piece, stand(draw, size, torch.stack([w, d], -1), 0.4)


def chairs(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """A seat with a back on four legs."""
    n = (len(size), count)
    w = draw.uniform(0.19, 0.3, *n)
    height = draw.uniform(0.38, 0.55, *n)
    back = draw.uniform(0.15, 0.4, *n)
    thick = draw.log_uniform(0.01, 0.05, *n)
    piece = boxes((0 * w, 0 * w, height, w, w, thick), (0 * w, -w, height + back, w, thick, back))
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
    w = draw.uniform(0.4, 1.1, *n)
    d = draw.uniform(0.35, 0.5, *n)
    seat = draw.uniform(0.16, 0.24, *n)
    back = draw.uniform(0.32, 0.5, *n)
    arm = draw.uniform(0.25, 0.34, *n)
    thick = draw.uniform(0.06, 0.13, *n)
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
    w = draw.uniform(0.3, 0.8, *n)
    d = draw.uniform(0.1, 0.22, *n)
    pitch = draw.uniform(0.22, 0.45, *n)
    thick = draw.uniform(0.006, 0.015, *n)
    boards = [(0 * w, 0 * w, (k + 0.2) * pitch, w, d, thick) for k in range(BOARDS)]
    tall = 0.5 * (BOARDS - 0.8) * pitch
    sides = [(s * w, 0 * w, tall, thick, d, tall) for s in (-1, 1)]
    return boxes(*boards, *sides), stand(draw, size, torch.stack([w, d], -1), 0.85)


def lamps(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Shades below the ceiling."""
    n = (len(size), count)
    low, high = draw.uniform(0.05, 0.3, *n), draw.uniform(0.02, 0.2, *n)
    tall = draw.uniform(0.03, 0.2, *n)
    drop = draw.uniform(0.05, 0.7, *n)
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
    thick = draw.log_uniform(0.003, 0.03, *n)
    rim = draw.log_uniform(0.004, 0.06, *n)
    free = (size[:, 2:] - 2 * h - 0.1).clamp_min(0)
    z = torch.where(door, h, h + 0.05 + draw.uniform(0.2, 1.0, *n) * free)
    piece = boxes((0 * w, 0 * w, z, w, 1.3 * thick, h), (0 * w, 0 * w, z, w + rim, thick, h + rim))
    return piece, stand(draw, size, torch.stack([w + rim, thick], -1), 1.0)


def skirting(draw: Draw, size: Float[Tensor, "b 3"]) -> StandingPiece:
    """A board along the foot of all four walls, in one piece."""
    b = len(size)
    thick = draw.log_uniform(0.004, 0.012, b, 1)
    tall = draw.log_uniform(0.02, 0.08, b, 1)
    x, y = 0.5 * size[:, :1], 0.5 * size[:, 1:2]
    rows = [(s * x, 0 * y, tall, thick, y, tall) for s in (-1, 1)]
    rows += [(0 * x, s * y, tall, x, thick, tall) for s in (-1, 1)]
    position = torch.stack([x, y, 0 * x], -1)
    return boxes(*rows), FloorPose(position, 0 * x)


def plants(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Randomly rotated flat ellipsoids above a pot."""
    n = (len(size), count)
    radius = draw.uniform(0.06, 0.18, *n)
    tall = draw.uniform(0.06, 0.2, *n)
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
    depth = draw.uniform(0.06, 0.1, *n, 1)
    tall = draw.uniform(0.08, 0.13, *n, 1)
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
    standing = torch.eye(3).expand(*n, 3, 3)
    flat = about_z(draw.integers(2, *n) * (torch.pi / 2)) @ standing[..., [2, 0, 1], :]
    way = draw.choose((0.5, 0.35, 0.15), *n)[..., None, None]
    rotation = torch.where(way == 0, standing, torch.where(way == 1, flat, draw.rotation(*n)))
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
    middle = 0.5 * size[:, :2]
    zero = torch.zeros(len(size), 2)
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


def railings(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Balusters, round or square, between two rails: on the floor, or hung like a shutter."""
    n = (len(size), count)
    w = draw.log_uniform(0.25, 1.2, *n)
    tall = draw.log_uniform(0.15, 0.6, *n)
    thin = draw.log_uniform(0.003, 0.025, *n)
    rail = draw.log_uniform(0.008, 0.04, *n)
    places = torch.linspace(-1, 1, BALUSTERS).tolist()
    balusters = boxes(*((x * (w - thin), 0 * w, tall, thin, thin, tall) for x in places))
    kind = torch.where(draw.chance(0.5, *n)[..., None], FRUSTUM, balusters.kind)
    rails = boxes(*((0 * w, 0 * w, z * tall, w, rail, 0.7 * rail) for z in (0.1, 2.0)))
    piece = Solids.join([rails, replace(balusters, kind=kind)])
    return piece, _lifted(draw, size, stand(draw, size, torch.stack([w, rail], -1), 0.15), tall)


def lattices(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Bars that cross: grids, window bars, racks, shelves without backs; some lie flat."""
    n = (len(size), count)
    w = draw.log_uniform(0.1, 0.8, *n)
    tall = draw.log_uniform(0.1, 0.8, *n)
    thin = draw.log_uniform(0.003, 0.02, *n)
    deep = draw.log_uniform(0.003, 0.12, *n)
    flat = draw.chance(0.2, *n)
    rows = []
    for p in torch.linspace(-1, 1, BARS).tolist():
        rows.append((p * w, 0 * w, tall, thin, deep, tall))
        rows.append((0 * w, 0 * w, tall + p * tall, w, deep, thin))
    piece = boxes(*rows)
    lying = replace(piece, centre=piece.centre[..., [0, 2, 1]], half=piece.half[..., [0, 2, 1]])
    place = stand(draw, size, torch.stack([w, torch.where(flat, tall, deep)], -1), 0.2)
    return where(flat, lying, piece), _lifted(draw, size, place, tall)


def cables(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> SolidBatch:
    """Cables and ropes that sag between two points anywhere in the room."""
    n = (len(size), count)
    ends = draw.uniform(0.02, 0.98, *n, 2, 3) * size[:, None, None]
    along = torch.linspace(0, 1, SEGMENTS + 1)[:, None]
    points = torch.lerp(ends[:, :, :1], ends[:, :, 1:], along)
    sag = (4 * along * (1 - along)) * draw.log_uniform(0.01, 0.6, *n)[..., None, None]
    points = points - sag * torch.tensor([0.0, 0.0, 1.0])
    points[..., 2] = points[..., 2].clamp_min(0.01)
    radius = draw.log_uniform(0.002, 0.02, *n)[..., None].expand(*n, SEGMENTS)
    step = torch.diff(points, dim=2)
    half = torch.stack([radius, radius, 0.5 * step.norm(dim=-1) + 0.5 * radius], -1)
    centre = 0.5 * (points[:, :, 1:] + points[:, :, :-1])
    kind = torch.full((*n, SEGMENTS), FRUSTUM)
    return Solids(kind, _along(step), centre, half).flatten()


def bushes(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Randomly rotated twigs, leaves or flat sticks around a point above the floor."""
    n = (len(size), count)
    reach = draw.log_uniform(0.08, 0.5, *n)[..., None]
    length = reach * draw.uniform(0.3, 1.0, *n, TWIGS)
    wide = draw.log_uniform(0.002, 0.05, *n)[..., None].expand(*n, TWIGS)
    thick = wide * draw.uniform(0.2, 1.0, *n)[..., None]
    kind = draw.choose((0.3, 0.4, 0.3), *n)[..., None].expand(*n, TWIGS)  # box, frustum, ellipsoid
    # A frustum's first two numbers are the radii of its ends.
    half = torch.stack([wide, torch.where(kind == FRUSTUM, 0.5 * wide, thick), length], -1)
    centre = reach[..., None] * draw.normal(0.45, *n, TWIGS, 3)
    middle = draw.uniform(0.1, 1.0, *n)[..., None] * (size[:, None, 2:] - 0.2)
    centre[..., 2] = centre[..., 2] + middle
    piece = Solids(kind, draw.rotation(*n, TWIGS), centre, half)
    return piece, stand(draw, size, reach.expand(*n, 2), 0.2)


def _lifted(draw: Draw, size: Float[Tensor, "b 3"], place: FloorPose, tall: Numbers) -> FloorPose:
    """Lift half of the pieces, which are 2 ``tall`` high, to a random height above the floor."""
    free = (size[:, 2:] - 2 * tall).clamp_min(0)
    lift = draw.chance(0.5, *tall.shape) * draw.uniform(0, 1, *tall.shape) * free
    return replace(place, position=place.position + functional.pad(lift[..., None], (2, 0)))


def _along(direction: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Rotations that take z to directions."""
    z = functional.normalize(direction, dim=-1)
    aside = torch.where(
        (z[..., :1].abs() < 0.7), torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    )
    x = functional.normalize(torch.linalg.cross(aside, z), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
