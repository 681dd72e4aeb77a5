"""The surfaces that rays meet in rooms, in PyTorch."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.raycast.rays import Hit
from geogs_synth.scene.rooms import Rooms
from geogs_synth.scene.solids import BOX, FRUSTUM


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
