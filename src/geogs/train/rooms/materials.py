"""What the surfaces of random rooms look like, and the light on them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.train.rooms.draw import Draw
from geogs.train.rooms.layout import Layout
from geogs.train.rooms.scene import Lights, Surfaces

_PLAIN_WALL, _PLAIN_FLOOR, _PLAIN_CEILING, _PLAIN_SOLID = 0.5, 0.2, 0.8, 0.3
"""Shares of the surfaces that have next to no texture."""
_LIGHTS = 3


def draw_surfaces(draw: Draw, layout: Layout, textures: int) -> Surfaces:
    """Materials for the room's six faces and two surfaces of each solid."""
    b, n = layout.solids.kind.shape
    walls = _draw(draw, textures, _plain_faces(draw, b), (0.4, 8.0))
    solids = _draw(draw, textures, draw.chance(_PLAIN_SOLID, b, 2 * n), (0.08, 5.0))
    solids = _show_pictures(draw, solids, layout)
    wall = torch.arange(6, device=draw.device).repeat(b, 1)
    wall[:, :4] = torch.where(draw.chance(0.6, b)[:, None], 0, wall[:, :4])
    owner = torch.stack([2 * layout.material, 2 * layout.material + 1], -1).flatten().repeat(b, 1)
    # The ends of most solids look like their sides.
    owner = torch.where(draw.chance(0.6, b, 2 * n), owner - owner % 2, owner)
    return _join(_pick(walls, wall), _pick(solids, owner))


def _plain_faces(draw: Draw, rooms: int) -> Bool[Tensor, "b 6"]:
    shares = [_PLAIN_WALL] * 4 + [_PLAIN_FLOOR, _PLAIN_CEILING]
    return draw.uniform(0, 1, rooms, 6) < torch.tensor(shares, device=draw.device)


def _draw(
    draw: Draw, textures: int, plain: Bool[Tensor, "b s"], period: tuple[float, float]
) -> Surfaces:
    """Random surfaces; ``period`` is the range of a texture's width in metres."""
    n = plain.shape
    angle = torch.where(draw.chance(0.6, *n), 0.0, draw.uniform(-3.15, 3.15, *n))
    angle = angle + draw.integers(4, *n) * (torch.pi / 2)
    scale = 1 / draw.log_uniform(*period, *n)
    c, s = scale * angle.cos(), scale * angle.sin()
    lightness = torch.where(plain, draw.uniform(0.35, 1.9, *n), draw.uniform(0.6, 1.6, *n))
    hue = 1 + draw.uniform(0, 0.25, *n)[..., None] * draw.uniform(-1, 1, *n, 3)
    faint = draw.chance(0.5, *n) * draw.log_uniform(0.005, 0.06, *n)
    detail = torch.where(draw.chance(0.5, *n), draw.log_uniform(0.03, 0.5, *n), 0.0)
    glossy = draw.chance(0.3, *n)
    return Surfaces(
        texture=draw.integers(textures, *n),
        matrix=torch.stack([c, -s, s, c], -1).unflatten(-1, (2, 2)),
        offset=draw.uniform(0, 1, *n, 2),
        contrast=torch.where(plain, faint, draw.log_uniform(0.25, 1.3, *n)),
        tint=lightness[..., None] * hue,
        noise=draw.integers(textures, *n),
        noise_scale=1 / draw.log_uniform(0.05, 1.5, *n),
        detail=torch.where(plain, draw.chance(0.5, *n) * draw.log_uniform(0.002, 0.03, *n), detail),
        gloss=torch.where(glossy, draw.log_uniform(0.02, 0.6, *n), 0.0),
        shininess=draw.log_uniform(4.0, 200.0, *n),
        glow=torch.zeros(n, device=draw.device),
    )


def _show_pictures(draw: Draw, surfaces: Surfaces, layout: Layout) -> Surfaces:
    """What hangs on a wall shows about one texture; some of it is a bright window or screen."""
    picture = (layout.picture == 1).repeat_interleave(2)
    half = layout.solids.half.repeat_interleave(2, 1)
    n = picture.shape[0]
    b = len(half)
    width = 2 * torch.maximum(half[..., 0], half[..., 2]) * draw.uniform(1.0, 2.0, b, n)
    scale = (1 / width)[..., None, None] * torch.eye(2, device=draw.device)
    bright = draw.chance(0.2, b, n) * draw.log_uniform(0.5, 4.0, b, n)
    plain = draw.chance(0.25, b, n)
    return Surfaces(
        texture=surfaces.texture,
        matrix=torch.where(picture[:, None, None], scale, surfaces.matrix),
        offset=surfaces.offset,
        contrast=torch.where(picture & ~plain, 1.0, surfaces.contrast),
        tint=surfaces.tint,
        noise=surfaces.noise,
        noise_scale=surfaces.noise_scale,
        detail=torch.where(picture, 0.0, surfaces.detail),
        gloss=surfaces.gloss,
        shininess=surfaces.shininess,
        glow=torch.where(picture, bright, surfaces.glow),
    )


def _pick(surfaces: Surfaces, index: Int[Tensor, "b s"]) -> Surfaces:
    rows = torch.arange(len(index), device=index.device)[:, None]
    return Surfaces(*(value[rows, index] for value in vars(surfaces).values()))


def _join(first: Surfaces, second: Surfaces) -> Surfaces:
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return Surfaces(*(torch.cat(pair, 1) for pair in pairs))


@dataclass(frozen=True)
class _Light:
    """One state of the light in b rooms."""

    position: Float[Tensor, "b l 3"]
    colour: Float[Tensor, "b l 3"]
    radius: Float[Tensor, "b l"]
    above: Float[Tensor, "b 3"]
    below: Float[Tensor, "b 3"]


def draw_lights(draw: Draw, size: Float[Tensor, "b 3"], views: int, change: float) -> Lights:
    """One to three lights under the ceiling; in a share of the rooms they change between views."""
    b = len(size)
    first, second = _light(draw, size), _light(draw, size)
    moment = draw.integers(max(views - 1, 1), b) + 1
    later = torch.arange(views, device=draw.device) >= moment[:, None]
    changed = draw.chance(change, b)[:, None] & later

    def per_view(a: Tensor, z: Tensor) -> Tensor:
        pick = changed.reshape(b, views, *[1] * (a.ndim - 1))
        return torch.where(pick, z[:, None], a[:, None])

    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return Lights(*(per_view(*pair) for pair in pairs))


def _light(draw: Draw, size: Float[Tensor, "b 3"]) -> _Light:
    b = len(size)
    n = (b, _LIGHTS)
    position = draw.uniform(0.05, 0.95, *n, 3)
    position[..., 2] = 1 - 0.5 * position[..., 2].square()
    there = torch.arange(_LIGHTS, device=draw.device) <= draw.integers(_LIGHTS, b)[:, None]
    warmth = draw.uniform(-0.35, 0.35, *n)[..., None]
    white = 1 + warmth * torch.tensor([1.0, 0.1, -1.0], device=draw.device)
    power = there * draw.log_uniform(0.7, 6.0, *n)
    ambient = draw.log_uniform(0.12, 1.0, b)[:, None]
    cast = 1 + draw.uniform(-0.15, 0.15, b, 3)
    return _Light(
        position=position * size[:, None],
        colour=power[..., None] * white,
        radius=draw.log_uniform(0.02, 0.3, *n),
        above=ambient * cast,
        below=ambient * draw.uniform(0.4, 0.9, b)[:, None] * (1 + draw.uniform(-0.15, 0.15, b, 3)),
    )
