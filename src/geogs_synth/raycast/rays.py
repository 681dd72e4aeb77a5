"""Rays against rooms in plain PyTorch: the specification of the kernels.

A ray is ``origin + t * direction`` with any length of the direction. Solids are convex and only
entered from outside, so each has at most one hit.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.scene.rooms import BOX, ELLIPSOID, FRUSTUM, Rooms, Solids

NEAREST = 1e-4
"""Hits at a smaller t do not count."""
_TINY = 1e-9


@dataclass(frozen=True)
class Hit:
    """Where rays meet a room or what stands in it."""

    t: Float[Tensor, "b m"]
    """In units of the direction."""
    solid: Int[Tensor, "b m"]
    """-1 where it is the room itself."""


@dataclass(frozen=True)
class SurfacePoint:
    """The surface at a hit."""

    position: Float[Tensor, "b m 3"]
    """World, metres."""
    normal: Float[Tensor, "b m 3"]
    """World, unit, outwards of the solid or into the room."""
    coordinates: Float[Tensor, "b m 2"]
    """On the surface, metres."""
    surface: Int[Tensor, "b m"]
    """Index of the surface."""


def closest_hit(
    size: Float[Tensor, "b 3"], solids: Solids, origin: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
) -> Hit:  # fmt: skip
    """The first thing that each ray from inside a room meets."""
    t_room = _room_exit(size, origin, direction)
    t, solid = entry(solids, origin, direction).min(-1)
    inside = t < t_room
    return Hit(torch.where(inside, t, t_room), torch.where(inside, solid, -1))


def occluded(
    solids: Solids, origin: Float[Tensor, "b m 3"], direction: Float[Tensor, "b m 3"],
    end: Float[Tensor, "b m"],
) -> Bool[Tensor, "b m"]:  # fmt: skip
    """Whether a solid is met before ``t = end``."""
    return (entry(solids, origin, direction) < end[..., None]).any(-1)


def entry(
    solids: Solids, origin: Float[Tensor, "b m 3"], direction: Float[Tensor, "b m 3"]
) -> Float[Tensor, "b m n"]:
    """t at which each ray enters each solid; infinite where it does not."""
    t = origin.new_full((*origin.shape[:2], solids.kind.shape[1]), math.inf)
    for kind, enter in (
        (BOX, _enter_box),
        (FRUSTUM, _enter_frustum),
        (ELLIPSOID, _enter_ellipsoid),
    ):
        places = _places(solids, kind)
        part = solids.at(places)
        o = _to_local(part, origin)
        d = torch.einsum("bnij,bmi->bmnj", part.rotation, direction)
        # From the point nearest to the solid's centre the equations lose no digits to distance.
        t0 = -(o * d).sum(-1) / (d * d).sum(-1)
        there = enter(o + t0[..., None] * d, d, part.half[:, None], NEAREST - t0) + t0
        meets = (part.kind[:, None] == kind) & (there > NEAREST)
        t[..., places] = torch.where(meets, there, t[..., places])
    return t


def surface_point(
    rooms: Rooms, hit: Hit, origin: Float[Tensor, "b m 3"], direction: Float[Tensor, "b m 3"]
) -> SurfacePoint:
    """Normal and surface coordinates at the hits."""
    position = origin + hit.t[..., None] * direction
    room = hit.solid < 0
    walls = _room_surface(rooms.size, position)
    s = rooms.solids
    place = hit.solid.clamp_min(0)
    which = torch.arange(len(place), device=place.device)[:, None]
    rotation, half, kind = s.rotation[which, place], s.half[which, place], s.kind[which, place]
    local = torch.einsum("bmij,bmi->bmj", rotation, position - s.centre[which, place])
    normal, coordinates, end = _solid_surface(kind, local, half)
    normal = torch.einsum("bmij,bmj->bmi", rotation, normal)
    pick = room[..., None]
    return SurfacePoint(
        position,
        torch.where(pick, walls[0], normal),
        torch.where(pick, walls[1], coordinates),
        torch.where(room, walls[2], 6 + 2 * place + end.long()),
    )


def signed_distance(solids: Solids, points: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m n"]:
    """Distance in metres from points to solids, negative inside; infinite for empty places.

    Exact outside boxes, close to it near the others.
    """
    distance = points.new_full((*points.shape[:2], solids.kind.shape[1]), math.inf)
    kinds = ((BOX, _box_distance), (FRUSTUM, _frustum_distance), (ELLIPSOID, _ellipsoid_distance))
    for kind, measure in kinds:
        places = _places(solids, kind)
        part = solids.at(places)
        there = measure(_to_local(part, points), part.half[:, None])
        one = part.kind[:, None] == kind
        distance[..., places] = torch.where(one, there, distance[..., places])
    return distance


def wall_distance(
    size: Float[Tensor, "b 3"], points: Float[Tensor, "b m 3"]
) -> Float[Tensor, "b m"]:
    """Distance in metres from points inside a room to its nearest face."""
    return torch.minimum(points, size[:, None] - points).amin(-1)


def _places(solids: Solids, kind: int) -> Int[Tensor, "k"]:
    """The places where some room has a solid of a kind; all of them on a GPU."""
    n, device = solids.kind.shape[1], solids.kind.device
    if device.type != "cpu":  # to know how many there are, the host would have to wait
        return torch.arange(n, device=device)
    return (solids.kind == kind).any(0).nonzero()[:, 0]


def _to_local(solids: Solids, points: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m n 3"]:
    """Points in the frame of each solid."""
    return torch.einsum(
        "bnij,bmni->bmnj", solids.rotation, points[:, :, None] - solids.centre[:, None]
    )


def _box_distance(p: Tensor, half: Tensor) -> Tensor:
    q = p.abs() - half
    return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)


def _frustum_distance(p: Tensor, half: Tensor) -> Tensor:
    slope = (half[..., 1] - half[..., 0]) / (2 * half[..., 2])
    side = p[..., :2].norm(dim=-1) - 0.5 * (half[..., 0] + half[..., 1]) - slope * p[..., 2]
    side = side / (1 + slope * slope).sqrt()
    cap = p[..., 2].abs() - half[..., 2]
    outside = (side.clamp_min(0).square() + cap.clamp_min(0).square()).sqrt()
    return outside + torch.maximum(side, cap).clamp_max(0)


def _ellipsoid_distance(p: Tensor, half: Tensor) -> Tensor:
    k0, k1 = (p / half).norm(dim=-1), (p / half.square()).norm(dim=-1)
    return k0 * (k0 - 1) / k1.clamp_min(1e-6)


def _room_exit(
    size: Float[Tensor, "b 3"], origin: Float[Tensor, "b m 3"], direction: Float[Tensor, "b m 3"]
) -> Float[Tensor, "b m"]:
    d = _away_from_zero(direction)
    return (torch.where(d > 0, size[:, None] - origin, -origin) / d).amin(-1)


def _room_surface(
    size: Float[Tensor, "b 3"], position: Float[Tensor, "b m 3"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Normal, coordinates and surface of the face on which points of a room lie."""
    gaps = torch.stack([position.abs(), (size[:, None] - position).abs()], -1).flatten(-2)
    face = gaps.argmin(-1)
    axis = face // 2
    normal = torch.nn.functional.one_hot(axis, 3) * (1 - 2 * (face % 2))[..., None]
    return normal.to(position.dtype), _across(position, axis), face


def _across(p: Float[Tensor, "b m 3"], axis: Int[Tensor, "b m"]) -> Float[Tensor, "b m 2"]:
    """The two coordinates other than the axis."""
    first = torch.where(axis == 0, p[..., 1], p[..., 0])
    second = torch.where(axis == 2, p[..., 1], p[..., 2])
    return torch.stack([first, second], -1)


def _solid_surface(
    kind: Int[Tensor, "b m"], p: Float[Tensor, "b m 3"], half: Float[Tensor, "b m 3"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Local normal, coordinates, and whether it is an end face, at local points on solids."""
    axis = (p.abs() - half).argmax(-1)
    box = torch.nn.functional.one_hot(axis, 3) * torch.where(p < 0, -1.0, 1.0).to(p.dtype)
    box_at, box_end = _across(p, axis), axis == 2

    x, y, z = p.unbind(-1)
    slope = (half[..., 1] - half[..., 0]) / (2 * half[..., 2])
    radius = (x * x + y * y).sqrt()
    side_gap = (radius - 0.5 * (half[..., 0] + half[..., 1]) - slope * z).abs()
    cap = (z.abs() - half[..., 2]).abs() < side_gap
    around = torch.atan2(y, x)
    out = torch.stack([x, y, -slope * radius], -1)
    up = torch.stack([torch.zeros_like(z), torch.zeros_like(z), torch.where(z < 0, -1.0, 1.0)], -1)
    frustum = torch.where(cap[..., None], up.to(p.dtype), out)
    side_at = torch.stack([around * torch.maximum(half[..., 0], half[..., 1]), z], -1)
    frustum_at = torch.where(cap[..., None], p[..., :2], side_at)

    height = (z / half[..., 2]).clamp(-1, 1).asin() * half[..., 2]
    ellipsoid, ellipsoid_at = p / half.square(), torch.stack([around * half[..., 0], height], -1)

    def choose(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        k = kind.reshape(*kind.shape, *[1] * (a.ndim - kind.ndim))
        return torch.where(k == BOX, a, torch.where(k == FRUSTUM, b, c))

    normal = torch.nn.functional.normalize(choose(box, frustum, ellipsoid), dim=-1)
    end = choose(box_end, cap, torch.zeros_like(cap))
    return normal, choose(box_at, frustum_at, ellipsoid_at), end


def _away_from_zero(d: Tensor) -> Tensor:
    return torch.where(d.abs() < _TINY, torch.where(d < 0, -_TINY, _TINY).to(d.dtype), d)


def _enter_box(o: Tensor, d: Tensor, half: Tensor, least: Tensor) -> Tensor:
    d = _away_from_zero(d)
    middle, reach = -o / d, half / d.abs()
    near, far = (middle - reach).amax(-1), (middle + reach).amin(-1)
    return torch.where(near <= far, near, math.inf)


def _enter_ellipsoid(o: Tensor, d: Tensor, half: Tensor, least: Tensor) -> Tensor:
    o, d = o / half, d / half
    a, b = (d * d).sum(-1), (o * d).sum(-1)
    nearest = o - (b / a)[..., None] * d
    rest = 1 - (nearest * nearest).sum(-1)
    return torch.where(rest >= 0, (-b - (rest.clamp_min(0) * a).sqrt()) / a, math.inf)


def _enter_frustum(o: Tensor, d: Tensor, half: Tensor, least: Tensor) -> Tensor:
    """The smallest t above ``least`` on the round side or on an end."""
    height = half[..., 2]
    middle = 0.5 * (half[..., 0] + half[..., 1])
    slope = (half[..., 1] - half[..., 0]) / (2 * height)
    level = middle + slope * o[..., 2]
    a = d[..., 0] ** 2 + d[..., 1] ** 2 - (slope * d[..., 2]) ** 2
    a = _away_from_zero(a)
    b = o[..., 0] * d[..., 0] + o[..., 1] * d[..., 1] - slope * d[..., 2] * level
    c = o[..., 0] ** 2 + o[..., 1] ** 2 - level**2
    rest = b * b - a * c
    root = rest.clamp_min(0).sqrt()
    best = torch.full_like(b, math.inf)
    for sign in (-1, 1):
        t = (-b + sign * root) / a
        on = (rest >= 0) & ((o[..., 2] + t * d[..., 2]).abs() <= height) & (t > least)
        best = torch.where(on & (t < best), t, best)
    dz = _away_from_zero(d[..., 2])
    for sign in (-1, 1):
        t = (sign * height - o[..., 2]) / dz
        x, y = o[..., 0] + t * d[..., 0], o[..., 1] + t * d[..., 1]
        radius = half[..., 1] if sign > 0 else half[..., 0]
        on = (x * x + y * y <= radius * radius) & (t > least)
        best = torch.where(on & (t < best), t, best)
    return best
