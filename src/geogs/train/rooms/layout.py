"""Where things stand in random rooms: furniture, clutter on top of it, pictures, wires, lamps."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.train.rooms.draw import Draw, about_z
from geogs.train.rooms.scene import BOX, ELLIPSOID, FRUSTUM, NONE, Solids

_CUPBOARDS, _TABLES, _CHAIRS, _SHELVES, _PICTURES = 8, 3, 2, 2, 7
_WIRES, _CLUTTER, _TILTED, _LAMPS = 5, 16, 5, 2
_BOARDS = 5


@dataclass(frozen=True)
class Layout:
    """Solids of b rooms and which of them are made of one material."""

    solids: Solids
    material: Int[Tensor, "n"]
    """Index of the solid whose surfaces a place shares; its own for most."""
    picture: Int[Tensor, "n"]
    """1 for places that hang flat on a wall and show an image."""


@dataclass(frozen=True)
class _Part:
    """Solids in the frame of their piece of furniture: ``b k p`` for k pieces of p solids."""

    kind: Int[Tensor, "b k p"]
    centre: Float[Tensor, "b k p 3"]
    half: Float[Tensor, "b k p 3"]


@dataclass(frozen=True)
class _Place:
    """Where k pieces stand: their frame has x along the wall behind, y into the room, z up."""

    position: Float[Tensor, "b k 3"]
    yaw: Float[Tensor, "b k"]


def draw_layout(draw: Draw, size: Float[Tensor, "b 3"], density: tuple[float, float]) -> Layout:
    """Furnishes rooms of these sizes; ``density`` as in :class:`RoomOptions`."""
    b = len(size)
    cupboards, cupboard_place = _cupboards(draw, size)
    tables, table_place = _tables(draw, size)
    shelves, shelf_place = _shelves(draw, size)
    pieces = [
        (cupboards, cupboard_place),
        (tables, table_place),
        _chairs(draw, size),
        (shelves, shelf_place),
        _lamps(draw, size),
        _pictures(draw, size),
    ]
    share = draw.uniform(*density, b)[:, None]
    parts = [_put(draw, part, place, share) for part, place in pieces]
    tops = [
        _top_of(cupboards, cupboard_place, 0),
        _top_of(tables, table_place, 0),
        *(_top_of(shelves, shelf_place, k) for k in range(_BOARDS)),
    ]
    loose = [_clutter(draw, size, tops), _wires(draw, size), _tilted(draw, size)]
    for solids in loose:
        parts.append(solids.without(draw.uniform(0, 1, *solids.kind.shape) > share))
    return Layout(Solids.join(parts), *_materials(draw.device))


def _materials(device: torch.device) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """The first solid of each piece gives the material; and which places are pictures."""
    groups = [(_CUPBOARDS, 1), (_TABLES, 5), (_CHAIRS, 6), (_SHELVES, _BOARDS + 2), (_LAMPS, 1)]
    groups += [(_PICTURES, 1), (_CLUTTER + _WIRES + _TILTED, 1)]
    first: list[int] = []
    picture: list[int] = []
    for index, (pieces, each) in enumerate(groups):
        for _ in range(pieces):
            first += [len(first)] * each
            picture += [int(index == 5)] * each
    return torch.tensor(first, device=device), torch.tensor(picture, device=device)


def _put(draw: Draw, part: _Part, place: _Place, share: Float[Tensor, "b 1"]) -> Solids:
    """Pieces in their places; each is there with the room's probability."""
    b, k, p = part.kind.shape
    rotation = about_z(place.yaw)
    centre = torch.einsum("bkij,bkpj->bkpi", rotation, part.centre) + place.position[:, :, None]
    there = (draw.uniform(0, 1, b, k) < share)[..., None]
    kind = torch.where(there, part.kind, NONE)
    turn = rotation[:, :, None].expand(b, k, p, 3, 3)
    return Solids(
        kind.flatten(1), turn.flatten(1, 2), centre.flatten(1, 2), part.half.flatten(1, 2)
    )


def _stand(
    draw: Draw, size: Float[Tensor, "b 3"], half: Float[Tensor, "b k 2"], at_wall: float
) -> _Place:
    """Places on the floor: backs to a wall, or anywhere and turned anyhow."""
    b, k = half.shape[:2]
    wall = draw.integers(4, b, k)
    odd = wall % 2 == 1
    along = torch.where(odd, size[:, 1:2], size[:, :1])
    across = torch.where(odd, size[:, :1], size[:, 1:2])
    x = draw.uniform(-0.5, 0.5, b, k) * (along - 2 * half[..., 0]).clamp_min(0)
    y = -0.5 * across + half[..., 1] + draw.uniform(0, 0.03, b, k)
    back = draw.chance(at_wall, b, k)
    free_yaw = draw.uniform(-3.15, 3.15, b, k)
    yaw = torch.where(back, wall * (torch.pi / 2), free_yaw)
    reach = half.norm(dim=-1)[..., None]
    free = draw.uniform(-0.5, 0.5, b, k, 2) * (size[:, None, :2] - 2 * reach).clamp_min(0)
    c, s = yaw.cos(), yaw.sin()
    fixed = torch.stack([c * x - s * y, s * x + c * y], -1)
    centre = torch.where(back[..., None], fixed, free) + 0.5 * size[:, None, :2]
    return _Place(torch.cat([centre, torch.zeros_like(centre[..., :1])], -1), yaw)


def _boxes(*rows: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]) -> _Part:
    """Boxes from centre x, y, z and half extents x, y, z."""
    numbers = torch.stack([torch.stack(torch.broadcast_tensors(*r), -1) for r in rows], -2)
    kind = torch.full(numbers.shape[:-1], BOX, device=numbers.device)
    return _Part(kind, numbers[..., :3].contiguous(), numbers[..., 3:].contiguous())


def _cupboards(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[_Part, _Place]:
    """Boxes of all sizes on the floor: cupboards, chests, beds, pillars, a few round ones."""
    n = (len(size), _CUPBOARDS)
    w, d, h = (draw.log_uniform(*r, *n) for r in ((0.12, 0.9), (0.12, 0.42), (0.1, 1.1)))
    bed = draw.chance(0.15, *n)
    w, d, h = (torch.where(bed, x, y) for x, y in ((w + 0.5, w), (d + 0.4, d), (0.15 + 0.2 * h, h)))
    zero = torch.zeros_like(w)
    part = _boxes((zero, zero, h, w, d, h))
    round_ = draw.chance(0.12, *n)[..., None]
    barrel = torch.stack([d, d * draw.uniform(0.5, 1.2, *n), h], -1)[..., None, :]
    part = _Part(
        torch.where(round_, FRUSTUM, part.kind),
        part.centre,
        torch.where(round_[..., None], barrel, part.half),
    )
    return part, _stand(draw, size, torch.stack([w, d], -1), 0.7)


def _tables(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[_Part, _Place]:
    """A top on four legs: tables, desks, stools."""
    n = (len(size), _TABLES)
    w, d = draw.log_uniform(0.2, 0.95, *n), draw.log_uniform(0.2, 0.5, *n)
    thick, height = draw.log_uniform(0.008, 0.04, *n), draw.uniform(0.35, 1.0, *n)
    part = _with_legs(draw, _boxes((0 * w, 0 * w, height, w, d, thick)), w, d, height - thick)
    return part, _stand(draw, size, torch.stack([w, d], -1), 0.4)


def _chairs(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[_Part, _Place]:
    """A seat with a back on four legs."""
    n = (len(size), _CHAIRS)
    w, height = draw.uniform(0.19, 0.3, *n), draw.uniform(0.38, 0.55, *n)
    back = draw.uniform(0.15, 0.4, *n)
    thick = draw.log_uniform(0.01, 0.05, *n)
    part = _boxes(
        (0 * w, 0 * w, height, w, w, thick),
        (0 * w, -w, height + back, w, thick, back),
    )
    return _with_legs(draw, part, w, w, height - thick), _stand(
        draw, size, torch.stack([w, w], -1), 0.2
    )


def _with_legs(
    draw: Draw, part: _Part, w: Float[Tensor, "b k"], d: Float[Tensor, "b k"],
    height: Float[Tensor, "b k"],
) -> _Part:  # fmt: skip
    thick = draw.log_uniform(0.008, 0.04, *w.shape)
    x, y, z = w - thick, d - thick, 0.5 * height
    legs = _boxes(*((sx * x, sy * y, z, thick, thick, z) for sx in (-1, 1) for sy in (-1, 1)))
    kind = torch.where(draw.chance(0.4, *w.shape)[..., None], FRUSTUM, legs.kind)
    return _Part(
        torch.cat([part.kind, kind], 2),
        torch.cat([part.centre, legs.centre], 2),
        torch.cat([part.half, legs.half], 2),
    )


def _shelves(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[_Part, _Place]:
    """Boards between two sides."""
    n = (len(size), _SHELVES)
    w, d = draw.uniform(0.3, 0.8, *n), draw.uniform(0.1, 0.22, *n)
    pitch, thick = draw.uniform(0.22, 0.45, *n), draw.uniform(0.006, 0.015, *n)
    boards = [(0 * w, 0 * w, (k + 0.2) * pitch, w, d, thick) for k in range(_BOARDS)]
    tall = 0.5 * (_BOARDS - 0.8) * pitch
    sides = [(s * w, 0 * w, tall, thick, d, tall) for s in (-1, 1)]
    return _boxes(*boards, *sides), _stand(draw, size, torch.stack([w, d], -1), 0.85)


def _lamps(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[_Part, _Place]:
    """Shades below the ceiling."""
    n = (len(size), _LAMPS)
    low, high = draw.uniform(0.05, 0.3, *n), draw.uniform(0.02, 0.2, *n)
    tall, drop = draw.uniform(0.03, 0.2, *n), draw.uniform(0.05, 0.7, *n)
    z = size[:, 2:] - drop - tall
    part = _boxes((0 * low, 0 * low, z, low, high, tall))
    reach = low[..., None].expand(*n, 2)
    return _Part(torch.full_like(part.kind, FRUSTUM), part.centre, part.half), _stand(
        draw, size, reach, 0.0
    )


def _pictures(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[_Part, _Place]:
    """Thin boxes on the walls: pictures, boards, windows, doors, switches."""
    n = (len(size), _PICTURES)
    w, h = draw.log_uniform(0.05, 0.8, *n), draw.log_uniform(0.05, 0.8, *n)
    door = draw.chance(0.15, *n)
    w, h = torch.where(door, 0.3 + 0.2 * w, w), torch.where(door, 1.0, h)
    thick = draw.log_uniform(0.003, 0.03, *n)
    free = (size[:, 2:] - 2 * h - 0.1).clamp_min(0)
    z = torch.where(door, h, h + 0.05 + draw.uniform(0.2, 1.0, *n) * free)
    place = _stand(draw, size, torch.stack([w, thick], -1), 1.0)
    return _boxes((0 * w, 0 * w, z, w, thick, h)), place


def _top_of(part: _Part, place: _Place, which: int) -> Float[Tensor, "b k 6"]:
    """Centre (3), yaw and half extents (2) of the upper face of a solid of each piece."""
    rotation = about_z(place.yaw)
    centre = torch.einsum("bkij,bkj->bki", rotation, part.centre[:, :, which]) + place.position
    lift = torch.nn.functional.pad(part.half[:, :, which, 2:], (2, 0))
    return torch.cat([centre + lift, place.yaw[..., None], part.half[:, :, which, :2]], -1)


def _clutter(draw: Draw, size: Float[Tensor, "b 3"], tops: list[Tensor]) -> Solids:
    """Small things on the floor and on top of furniture."""
    n = (len(size), _CLUTTER)
    floor = torch.zeros(len(size), 1, 6, device=draw.device)
    floor[..., :2] = floor[..., 4:] = 0.5 * size[:, None, :2]
    supports = torch.cat([floor.expand(-1, 6, -1), *tops], 1)
    pick = draw.integers(supports.shape[1], *n)
    support = supports.gather(1, pick[..., None].expand(*n, 6))
    kind = draw.choose((0.45, 0.3, 0.25), *n)
    large = draw.log_uniform(0.02, 0.16, *n)[..., None]
    half = large * draw.uniform(0.35, 1.0, *n, 3)
    wide = half[..., :1]
    cone = torch.cat([wide, wide * draw.uniform(0.4, 1.2, *n)[..., None], half[..., 2:]], -1)
    cylinder = torch.cat([wide, wide, half[..., 2:]], -1)
    cone = torch.where(draw.chance(0.5, *n)[..., None], cone, cylinder)
    half = torch.where((kind == FRUSTUM)[..., None], cone, half)
    yaw = draw.uniform(-3.15, 3.15, *n)
    offset = draw.uniform(-0.9, 0.9, *n, 2) * support[..., 4:]
    turn = about_z(support[..., 3])[..., :2, :2]
    xy = support[..., :2] + torch.einsum("bkij,bkj->bki", turn, offset)
    centre = torch.cat([xy, support[..., 2:3] + half[..., 2:]], -1)
    return Solids(kind, about_z(yaw), centre, half)


def _wires(draw: Draw, size: Float[Tensor, "b 3"]) -> Solids:
    """Thin rods: upright, along a wall, or anyhow."""
    n = (len(size), _WIRES)
    radius = draw.log_uniform(0.004, 0.025, *n)
    half = torch.stack([radius, radius, draw.log_uniform(0.15, 1.4, *n)], -1)
    upright = torch.eye(3, device=draw.device).expand(*n, 3, 3)
    flat = upright[..., [2, 0, 1], :]
    way = draw.choose((0.4, 0.3, 0.3), *n)[..., None, None]
    level = about_z(draw.integers(2, *n) * (torch.pi / 2)) @ flat
    rotation = torch.where(way == 0, upright, torch.where(way == 1, level, draw.rotation(*n)))
    return Solids(
        torch.full(n, FRUSTUM, device=draw.device), rotation, _anywhere(draw, size, n), half
    )


def _tilted(draw: Draw, size: Float[Tensor, "b 3"]) -> Solids:
    """Slabs, boxes and ellipsoids turned anyhow."""
    n = (len(size), _TILTED)
    half = draw.log_uniform(0.05, 0.5, *n, 3)
    half[..., 2] = half[..., 2] * draw.log_uniform(0.03, 1.0, *n)
    half = half.clamp_min(0.004)
    kind = torch.where(draw.chance(0.3, *n), ELLIPSOID, BOX)
    return Solids(kind, draw.rotation(*n), _anywhere(draw, size, n), half)


def _anywhere(draw: Draw, size: Float[Tensor, "b 3"], n: tuple[int, int]) -> Float[Tensor, "b k 3"]:
    return draw.uniform(0.03, 0.97, *n, 3) * size[:, None]
