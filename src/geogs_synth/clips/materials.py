"""Appearance of the surfaces of random rooms."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.clips.furnishing import Furnishing
from geogs_synth.draw import Draw
from geogs_synth.scene.batch import concatenate, gather
from geogs_synth.scene.rooms import Surfaces

_PLAIN = (0.5, 0.5, 0.5, 0.5, 0.2, 0.8)
"""Fraction of each wall, the floor and the ceiling that has next to no texture."""
_SHOWS_IMAGE = (0.12, 0.12, 0.12, 0.12, 0.12, 0.04)
"""Fraction of them that show images rather than materials."""


def draw_surfaces(draw: Draw, layout: Furnishing, textures: int, materials: int) -> Surfaces:
    """Appearance of the room's six faces and of two surfaces of each solid.

    The first ``materials`` of the ``textures`` in the bank are materials, the others images.
    """
    b, n = layout.solids.kind.shape
    plain = draw.uniform(0, 1, b, 6) < torch.tensor(_PLAIN)
    image = draw.uniform(0, 1, b, 6) < torch.tensor(_SHOWS_IMAGE)
    walls = _draw(draw, plain, _texture(draw, image, textures, materials), textures, (0.4, 8.0))
    polished = (draw.chance(0.15, b) * draw.log_uniform(0.03, 0.5, b))[:, None]
    walls = replace(walls, mirror=torch.tensor([0.0] * 4 + [1.0, 0.0]) * polished)

    plain = draw.chance(0.35, b, 2 * n)
    image = draw.chance(0.35, b, 2 * n)
    texture = _texture(draw, image, textures, materials)
    solids = _draw(draw, plain, texture, textures, (0.08, 5.0))
    pictures = _texture(draw, torch.ones_like(image), textures, materials)
    solids = _show_pictures(draw, solids, layout, pictures)

    wall = torch.arange(6).repeat(b, 1)
    wall[:, :4] = torch.where(draw.chance(0.6, b)[:, None], 0, wall[:, :4])
    owner = torch.stack([2 * layout.material, 2 * layout.material + 1], -1).flatten().repeat(b, 1)
    # The ends of most solids look like their sides.
    owner = torch.where(draw.chance(0.6, b, 2 * n), owner - owner % 2, owner)
    return concatenate(gather(walls, wall), gather(solids, owner))


def _texture(
    draw: Draw, image: Bool[Tensor, "b s"], textures: int, materials: int
) -> Int[Tensor, "b s"]:
    images = materials + draw.integers(textures - materials, *image.shape)
    return torch.where(image, images, draw.integers(materials, *image.shape))


def _draw(
    draw: Draw,
    plain: Bool[Tensor, "b s"],
    texture: Int[Tensor, "b s"],
    textures: int,
    period: tuple[float, float],
) -> Surfaces:
    """Random surfaces; ``period`` is the range of a texture's width in metres."""
    n = plain.shape
    quarter = torch.where(draw.chance(0.7, *n), 0, draw.integers(4, *n)) * (torch.pi / 2)
    angle = quarter + torch.where(draw.chance(0.7, *n), 0.0, draw.uniform(-3.15, 3.15, *n))
    scale = 1 / draw.log_uniform(*period, *n)
    lightness = torch.where(plain, draw.uniform(0.4, 1.9, *n), draw.uniform(0.7, 1.6, *n))
    # Most surfaces are nearly grey, a few are colourful.
    chroma = 0.4 * draw.uniform(0, 1, *n).pow(2.5)
    hue = 1 + chroma[..., None] * draw.uniform(-1, 1, *n, 3)
    warmth = draw.uniform(-0.02, 0.12, *n)[..., None] * torch.tensor([1.0, 0.2, -1.0])
    faint = draw.chance(0.5, *n) * draw.log_uniform(0.005, 0.06, *n)
    stain = draw.chance(0.5, *n) * draw.log_uniform(0.002, 0.03, *n)
    detail = draw.chance(0.5, *n) * draw.log_uniform(0.03, 0.5, *n)
    return Surfaces(
        texture=texture,
        matrix=_matrix(scale, angle),
        offset=draw.uniform(0, 1, *n, 2),
        contrast=torch.where(plain, faint, draw.log_uniform(0.25, 1.2, *n)),
        tint=lightness[..., None] * hue * (1 + warmth),
        noise=draw.integers(textures, *n),
        noise_scale=1 / draw.log_uniform(0.05, 1.5, *n),
        detail=torch.where(plain, stain, detail),
        gloss=draw.chance(0.3, *n) * draw.log_uniform(0.02, 0.6, *n),
        shininess=draw.log_uniform(4.0, 200.0, *n),
        glow=torch.zeros(n),
        mirror=draw.chance(0.06, *n) * draw.log_uniform(0.03, 0.5, *n),
    )


def _matrix(scale: Float[Tensor, "b s"], angle: Float[Tensor, "b s"]) -> Float[Tensor, "b s 2 2"]:
    """Rotation and scale; upside down, because rows of an image go down."""
    c, s = scale * angle.cos(), scale * angle.sin()
    return torch.stack([c, s, s, -c], -1).unflatten(-1, (2, 2))


def _show_pictures(
    draw: Draw, surfaces: Surfaces, layout: Furnishing, images: Int[Tensor, "b s"]
) -> Surfaces:
    """Give solids on a wall about one image each; some are a bright window or screen."""
    picture = layout.picture.repeat_interleave(2)
    half = layout.solids.half.repeat_interleave(2, 1)
    b, n = half.shape[:2]
    width = 2 * torch.maximum(half[..., 0], half[..., 2]) * draw.uniform(1.0, 1.8, b, n)
    matrix = _matrix(1 / width, torch.zeros_like(width))
    bright = draw.chance(0.2, b, n) * draw.log_uniform(0.5, 4.0, b, n)
    plain = draw.chance(0.25, b, n)
    glass = draw.chance(0.25, b, n) * draw.log_uniform(0.1, 0.9, b, n)
    return replace(
        surfaces,
        texture=torch.where(picture, images, surfaces.texture),
        matrix=torch.where(picture[:, None, None], matrix, surfaces.matrix),
        contrast=torch.where(picture & ~plain, 1.0, surfaces.contrast),
        detail=torch.where(picture, 0.0, surfaces.detail),
        glow=torch.where(picture, bright, surfaces.glow),
        mirror=torch.where(picture, glass, surfaces.mirror),
    )


def papered(draw: Draw, surfaces: Surfaces, which: Bool[Tensor, "b"]) -> Surfaces:
    """Repeat one image exactly, often, on the walls, and half of the floors, of these rooms."""
    b = len(which)
    half = torch.tensor([True] * 4 + [False, False]).expand(b, 6) & which[:, None]
    floor = torch.tensor([False] * 4 + [True, False]).expand(b, 6)
    chosen = half | (floor & (which & draw.chance(0.5, b))[:, None])
    chosen = torch.nn.functional.pad(chosen, (0, surfaces.contrast.shape[1] - 6))
    scale = surfaces.matrix[..., 0].norm(dim=-1)
    wanted = 1 / draw.log_uniform(0.06, 0.7, b, 1)  # repeats per metre
    matrix = surfaces.matrix * (wanted / scale)[..., None, None]
    contrast = draw.log_uniform(0.15, 1.2, b, 1).expand_as(scale)
    return replace(
        surfaces,
        matrix=torch.where(chosen[..., None, None], matrix, surfaces.matrix),
        contrast=torch.where(chosen, contrast, surfaces.contrast),
        detail=torch.where(chosen, 0.0, surfaces.detail),
    )


def bared(draw: Draw, surfaces: Surfaces, which: Bool[Tensor, "b"]) -> Surfaces:
    """Give nearly all faces and most solids of these rooms one colour, or nearly."""
    b, s = surfaces.contrast.shape
    chosen = draw.chance(0.75, b, s)
    chosen[:, :6] = draw.chance(0.95, b, 6)
    chosen &= which[:, None]
    faint = draw.chance(0.5, b, s) * draw.log_uniform(0.003, 0.04, b, s)
    return replace(
        surfaces,
        contrast=torch.where(chosen, faint, surfaces.contrast),
        detail=torch.where(chosen, 0.3 * faint, surfaces.detail),
        mirror=torch.where(chosen, 0.0, surfaces.mirror),
    )
