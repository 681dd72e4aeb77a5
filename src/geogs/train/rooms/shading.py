"""Colours of surface points in plain PyTorch: the specification of the kernels' shading."""

from dataclasses import fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.train.rooms.raycast import SurfacePoint, occluded, signed_distance, wall_distance
from geogs.train.rooms.scene import Rooms, Surfaces
from geogs.train.rooms.textures import TextureBank

CORNERS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""A light is four points, one for each sample of a pixel: corners of a tetrahedron."""
CREASES = ((0.08, 0.35), (0.35, 0.45))
"""Height in metres above the surface where things in the way darken it, and how much."""
LIFT = 1e-3
"""Metres by which shadow rays start above their surface."""
SOFTENING = 0.3
"""Square metres added to the squared distance of lights, so that nothing near them burns out."""


def ambient_access(rooms: Rooms, point: SurfacePoint) -> Float[Tensor, "b m"]:
    """Share of the ambient light that reaches points: less in corners and next to things."""
    share = torch.ones_like(point.position[..., 0])
    for height, strength in CREASES:
        above = point.position + height * point.normal
        free = signed_distance(rooms.solids, above).amin(-1)
        free = torch.minimum(free, wall_distance(rooms.size, above))
        share = share - strength * (1 - (free / height).clamp(0, 1))
    return share


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
    """Linear colour of points that one of the four samples of a view's pixels sees.

    ``direction`` is the ray's, ``footprint`` the width of a sample at the point in metres, across
    the ray, ``access`` what :func:`ambient_access` gives.
    """
    surface = _gather(rooms.surfaces, point.surface)
    towards = -torch.nn.functional.normalize(direction, dim=-1)
    cosine = (point.normal * towards).sum(-1).clamp(0.05, 1)
    albedo = _albedo(surface, bank, point.coordinates, footprint / cosine.sqrt(), sample)
    light = rooms.lights
    above, below = light.above[:, view, None], light.below[:, view, None]
    share = (0.5 + 0.5 * point.normal[..., 2:]) * access[..., None]
    diffuse = share * above + (access[..., None] - share) * below
    highlight = torch.zeros_like(diffuse)
    start = point.position + LIFT * point.normal
    corner = torch.tensor(CORNERS[sample], dtype=start.dtype, device=start.device)
    for k in range(light.position.shape[2]):
        ball = light.position[:, view, k] + light.radius[:, view, k, None] * corner
        ray = ball[:, None] - start
        squared = (ray * ray).sum(-1)
        unit = ray / squared.sqrt()[..., None]
        facing = (unit * point.normal).sum(-1).clamp_min(0)
        ones = torch.ones_like(facing)
        lit = (facing > 0) & ~occluded(rooms.solids, start, ray, ones)
        power = light.colour[:, view, k, None] * (lit * facing / (squared + SOFTENING))[..., None]
        diffuse = diffuse + power
        middle = torch.nn.functional.normalize(unit + towards, dim=-1)
        peak = (middle * point.normal).sum(-1).clamp_min(1e-4) ** surface.shininess
        highlight = highlight + power * peak[..., None]
    glow = surface.glow[..., None]
    return albedo * (diffuse + glow) + surface.gloss[..., None] * highlight


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
    """Level whose texels are as wide as the sample; the four samples round differently."""
    level = (repeats * bank.size).clamp_min(1e-6).log2() + (sample + 0.5) / 4
    return level.floor().clamp(0, bank.levels - 1).long()


def _gather(surfaces: Surfaces, index: Int[Tensor, "b m"]) -> Surfaces:
    rows = torch.arange(len(index), device=index.device)[:, None]
    return Surfaces(*(getattr(surfaces, f.name)[rows, index] for f in fields(Surfaces)))
