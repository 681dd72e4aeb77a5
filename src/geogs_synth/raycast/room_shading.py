"""Colours of surface points in plain PyTorch: the specification of the kernels' shading."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.raycast.rays import closest_hit, occluded
from geogs_synth.raycast.room_surface import SurfacePoint, surface_point
from geogs_synth.raycast.solid_distance import signed_distance, wall_distance
from geogs_synth.scene.batch import gather
from geogs_synth.scene.rooms import Lights, Rooms, Surfaces
from geogs_synth.textures.pyramids import TextureBank

CORNERS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""Four points of a light, one for each sample of a pixel: corners of a tetrahedron."""
CREASES = ((0.08, 0.35), (0.35, 0.45))
"""Heights in metres above a surface at which occluders darken it, and by how much."""
LIFT = 1e-3
"""Metres by which shadow rays start above their surface."""
SOFTENING = 0.3
"""Square metres added to the squared distance of lights, so that nothing near them burns out."""


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
