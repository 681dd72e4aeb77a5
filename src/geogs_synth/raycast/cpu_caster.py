"""The caster for the CPU: compiled rays, shading in PyTorch. The CUDA kernels do the same."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch, pixel_grid, project, rays, row_centre
from geogs_synth.raycast.rays import Hit, closest_hit, occluded
from geogs_synth.raycast.rendered_rooms import MARGIN, FlowTruth, RenderedRooms
from geogs_synth.raycast.solid_distance import signed_distance, wall_distance
from geogs_synth.scene.batch import gather, one_scene
from geogs_synth.scene.rooms import Lights, Rooms, Surfaces
from geogs_synth.scene.solids import BOX, FRUSTUM, SolidBatch
from geogs_synth.textures.pyramids import TextureBank

SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
"""Positions of a pixel's four samples in it: no two in a row or column."""
_CHUNK = 2048
"""Pixels at a time; the data of the rays then stays in the processor's cache."""
CORNERS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""Four points of a light, one for each sample of a pixel: corners of a tetrahedron."""
CREASES = ((0.08, 0.35), (0.35, 0.45))
"""Heights in metres above a surface at which occluders darken it, and by how much."""
LIFT = 1e-3
"""Metres by which shadow rays start above their surface."""
SOFTENING = 0.3
"""Square metres added to the squared distance of lights, so that nothing near them burns out."""


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


class CpuCaster:
    """Casts rays at batches of rooms, in the precision of the rooms and views."""

    def render(self, rooms: Rooms, bank: TextureBank, views: CameraBatch) -> RenderedRooms:
        """Render every view."""
        b, v = views.T_cw.shape[:2]
        x, y = pixel_grid(views)
        chunks = [slice(start, start + _CHUNK) for start in range(0, len(x), _CHUNK)]
        seen = [
            _look(one_scene(rooms, room), bank, one_scene(views, room), view, x[part], y[part])
            for room in range(b)
            for view in range(v)
            for part in chunks
        ]
        shape = (b, v, views.height, views.width)
        colour, depth, normal, solid = (torch.cat([s[k] for s in seen], 1) for k in range(4))
        colour, normal = (x.reshape(*shape, 3) for x in (colour, normal))
        normal = torch.einsum("bvij,bvhwj->bvhwi", views.T_cw[..., :3, :3], normal)
        colour, normal = (x.movedim(-1, 2).contiguous() for x in (colour, normal))
        return RenderedRooms(colour, depth.reshape(shape), normal, solid.reshape(shape))

    def flow(
        self, solids: SolidBatch, views: CameraBatch, points: Float[Tensor, "b h w 3"], view: int
    ) -> FlowTruth:
        """Pixels and visibility of world points in a view."""
        shape = points.shape[:3]
        point = points.flatten(1, 2)
        pixels, valid = project(views, view, point)
        limit = torch.tensor([views.width - 1, views.height - 1], device=pixels.device)
        inside = valid & ((pixels >= 0) & (pixels <= limit)).all(-1)
        centre = row_centre(views, view, pixels)
        ray = point - centre
        hidden = occluded(solids, centre, ray, 1 - MARGIN / ray.norm(dim=-1))
        visible = inside & ~hidden
        return FlowTruth(pixels.reshape(*shape, 2), visible.reshape(shape), valid.reshape(shape))

    def first_hit(
        self,
        size: Float[Tensor, "b 3"],
        solids: SolidBatch,
        origin: Float[Tensor, "b m 3"],
        direction: Float[Tensor, "b m 3"],
    ) -> Hit:
        """First hit of each ray from inside a room."""
        return closest_hit(size, solids, origin, direction)


def _look(
    rooms: Rooms,
    bank: TextureBank,
    views: CameraBatch,
    view: int,
    x: Float[Tensor, "m"],
    y: Float[Tensor, "m"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour, depth, normal (world frame) and solid of some pixels of a view."""
    origin, direction = rays(views, view, x, y)
    hit = closest_hit(rooms.size, rooms.solids, origin, direction)
    middle = surface_point(rooms, hit, origin, direction)
    access = ambient_access(rooms, middle)
    focal = (views.intrinsics[:, :1] * views.intrinsics[:, 1:2]).sqrt()
    total = torch.zeros_like(direction)
    for k in range(4):
        origin, ray = rays(views, view, x + SAMPLES[k][0], y + SAMPLES[k][1])
        seen = closest_hit(rooms.size, rooms.solids, origin, ray)
        point = surface_point(rooms, seen, origin, ray)
        footprint = 0.5 * seen.t * ray.norm(dim=-1) / focal
        total = total + shade(rooms, bank, point, view, k, ray, footprint, access)
    return total / 4, hit.t, middle.normal, hit.solid


def ambient_access(rooms: Rooms, point: SurfacePoint) -> Float[Tensor, "b m"]:
    """Fraction of the ambient light that reaches points: less in corners and next to things."""
    access = torch.ones_like(point.position[..., 0])
    bulk = 2 * rooms.solids.bounding_half.median(-1).values[:, None]
    for height, strength in CREASES:
        above = point.position + height * point.normal
        closed = 1 - (signed_distance(rooms.solids, above) / height).clamp(0, 1)
        # A wire lets nearly all light pass.
        closed = (closed * (bulk / height).clamp_max(1)).amax(-1)
        wall = 1 - (wall_distance(rooms.size, above) / height).clamp(0, 1)
        access = access - strength * torch.maximum(closed, wall)
    return access


def shade(
    rooms: Rooms,
    bank: TextureBank,
    point: SurfacePoint,
    view: int,
    sample: int,
    direction: Float[Tensor, "b m 3"],
    footprint: Float[Tensor, "b m"],
    access: Float[Tensor, "b m"],
) -> Float[Tensor, "b m 3"]:
    """Linear colour of the points that one of the four samples of a view's pixels sees.

    ``direction`` is the ray's, ``footprint`` the width of a sample at the point in metres, across
    the ray, ``access`` the result of :func:`ambient_access`.
    """
    surface = gather(rooms.surfaces, point.surface)
    towards = -torch.nn.functional.normalize(direction, dim=-1)
    cosine = (point.normal * towards).sum(-1).clamp(0.05, 1)
    albedo = _albedo(surface, bank, point.coordinates, footprint / cosine.sqrt(), sample)
    diffuse = _ambient(rooms.lights, point, view, access)
    highlight = torch.zeros_like(diffuse)
    start = point.position + LIFT * point.normal
    corner = torch.tensor(CORNERS[sample], dtype=start.dtype, device=start.device)
    light = rooms.lights
    for k in range(light.position.shape[2]):
        ball = light.position[:, view, k] + light.radius[:, view, k, None] * corner
        ray = ball[:, None] - start
        power = _lamp(ray, point, light.colour[:, view, k])
        shadow = occluded(rooms.solids, start, ray, torch.ones_like(access))
        power = torch.where(shadow[..., None], 0.0, power)
        diffuse = diffuse + power
        middle = torch.nn.functional.normalize(ray, dim=-1) + towards
        middle = torch.nn.functional.normalize(middle, dim=-1)
        peak = (middle * point.normal).sum(-1).clamp_min(1e-4) ** surface.shininess
        highlight = highlight + power * peak[..., None]
    glow = surface.glow[..., None]
    colour = albedo * (diffuse + glow) + surface.gloss[..., None] * highlight
    if not surface.mirror.any():
        return colour
    weight = (surface.mirror * (0.3 + 0.7 * (1 - cosine) ** 3))[..., None]
    mirrored = 2 * (towards * point.normal).sum(-1, keepdim=True) * point.normal - towards
    return (1 - weight) * colour + weight * _reflected(
        rooms, bank, start, mirrored, view, sample, footprint
    )


def _reflected(
    rooms: Rooms,
    bank: TextureBank,
    start: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
    view: int,
    sample: int,
    footprint: Float[Tensor, "b m"],
) -> Float[Tensor, "b m 3"]:
    """Light that mirroring points reflect along unit directions; it is without shadows."""
    hit = closest_hit(rooms.size, rooms.solids, start, direction)
    point = surface_point(rooms, hit, start, direction)
    surface = gather(rooms.surfaces, point.surface)
    cosine = -(point.normal * direction).sum(-1).clamp(-1.0, -0.05)
    # A polished surface is not as sharp as a mirror.
    footprint = (2 * footprint + 0.004 * hit.t) / cosine.sqrt()
    albedo = _albedo(surface, bank, point.coordinates, footprint, sample)
    light = _ambient(rooms.lights, point, view, torch.ones_like(cosine))
    light = light + surface.glow[..., None]
    for k in range(rooms.lights.position.shape[2]):
        ray = rooms.lights.position[:, view, k, None] - point.position
        light = light + _lamp(ray, point, rooms.lights.colour[:, view, k])
    return albedo * light


def _ambient(
    lights: Lights, point: SurfacePoint, view: int, access: Float[Tensor, "b m"]
) -> Float[Tensor, "b m 3"]:
    from_above = (0.5 + 0.5 * point.normal[..., 2:]) * access[..., None]
    above, below = lights.above[:, view, None], lights.below[:, view, None]
    return from_above * above + (access[..., None] - from_above) * below


def _lamp(
    ray: Float[Tensor, "b m 3"], point: SurfacePoint, colour: Float[Tensor, "b 3"]
) -> Float[Tensor, "b m 3"]:
    """Unoccluded irradiance from a light at the end of the rays."""
    squared = (ray * ray).sum(-1)
    facing = ((ray * point.normal).sum(-1) / squared.sqrt()).clamp_min(0)
    return colour[:, None] * (facing / (squared + SOFTENING))[..., None]


def _albedo(
    surface: Surfaces,
    bank: TextureBank,
    coordinates: Float[Tensor, "b m 2"],
    footprint: Float[Tensor, "b m"],
    sample: int,
) -> Float[Tensor, "b m 3"]:
    scale = surface.matrix[..., 0].norm(dim=-1)
    position = torch.einsum("bmij,bmj->bmi", surface.matrix, coordinates) + surface.offset
    level = _level(bank, scale * footprint, sample)
    texture = bank.sample(surface.texture, position, level) - 0.5
    position = coordinates * surface.noise_scale[..., None] + surface.offset
    level = _level(bank, surface.noise_scale * footprint, sample)
    noise = bank.sample(surface.noise, position, level)[..., 1:2] - 0.5
    colour = surface.tint * (0.5 + surface.contrast[..., None] * texture)
    colour = colour * (1 + 2 * surface.detail[..., None] * noise)
    return colour.clamp(0.02, 0.97).square()


def _level(bank: TextureBank, repeats: Float[Tensor, "b m"], sample: int) -> Int[Tensor, "b m"]:
    """Pyramid level with texels as wide as the sample; the four samples round differently."""
    level = (repeats * bank.size).clamp_min(1e-6).log2() + (sample + 0.5) / 4
    return level.floor().clamp(0, bank.levels - 1).long()


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
    rotation = s.rotation[which, place]
    half = s.half[which, place]
    kind = s.kind[which, place]
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
    box_at = _across(p, axis)
    box_end = axis == 2

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
    ellipsoid = p / half.square()
    ellipsoid_at = torch.stack([around * half[..., 0], height], -1)

    def choose(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        k = kind.reshape(*kind.shape, *[1] * (a.ndim - kind.ndim))
        return torch.where(k == BOX, a, torch.where(k == FRUSTUM, b, c))

    normal = torch.nn.functional.normalize(choose(box, frustum, ellipsoid), dim=-1)
    end = choose(box_end, cap, torch.zeros_like(cap))
    return normal, choose(box_at, frustum_at, ellipsoid_at), end
