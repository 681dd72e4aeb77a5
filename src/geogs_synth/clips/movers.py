"""People and cars that move from view to view."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.batch import chosen
from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, NONE, SolidBatch, Solids

BODIES, PARTS = 4, 3
"""Bodies of a scene, solids of each; they take the last places."""


def people(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    """Legs, trunk and head of people anywhere in rooms; what each part moves by per view."""
    n = (len(size), BODIES)
    foot = draw.uniform(0.1, 0.9, *n, 2) * size[:, None, :2]
    there = draw.chance(0.85, *n)
    return _people(draw, foot, there)


def _people(
    draw: Draw, foot: Float[Tensor, "b k 2"], there: Bool[Tensor, "b k"]
) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    n = foot.shape[:2]
    tall, wide = draw.uniform(1.2, 1.95, *n), draw.uniform(0.13, 0.26, *n)
    zero = torch.zeros_like(tall)
    middle = torch.stack([0.24 * tall, 0.65 * tall, 0.91 * tall], -1)
    half = torch.stack([
        torch.stack([0.6 * wide, 0.9 * wide, 0.24 * tall], -1),
        torch.stack([0.9 * wide, 1.1 * wide, 0.17 * tall], -1),
        torch.stack([zero + 0.09, zero + 0.11, 0.08 * tall], -1),
    ], 2)  # fmt: skip
    kind = torch.tensor([FRUSTUM, FRUSTUM, ELLIPSOID]).expand(*n, PARTS)
    centre = torch.cat([foot[:, :, None].expand(-1, -1, PARTS, -1), middle[..., None]], -1)
    lean = torch.nn.functional.pad(draw.normal(0.04, *n, PARTS, 2), (0, 1))
    rotation = about_z(draw.uniform(-3.15, 3.15, *n))[:, :, None].expand(-1, -1, PARTS, -1, -1)
    angle = draw.uniform(-3.15, 3.15, *n)
    way = draw.log_uniform(0.01, 0.5, *n)[..., None] * torch.stack([angle.cos(), angle.sin()], -1)
    # Legs and head do not move quite like the trunk.
    ways = way[:, :, None] * draw.uniform(0.8, 1.2, *n, PARTS, 1)
    ways = torch.nn.functional.pad(ways, (0, 1))
    kind = torch.where(there[..., None], kind, NONE)
    return Solids(kind, rotation, centre + lean, half).flatten(), ways.flatten(1, 2)


def traffic(
    draw: Draw, middle: Float[Tensor, "3"], scale: float, scenes: int
) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    """Cars on the road along x, and who walks beside it; scaled, around the middle."""
    n = (scenes, BODIES)
    x = draw.uniform(-12, 60, *n) * (1 - 2.0 * draw.chance(0.3, *n))
    foot = torch.stack([x, draw.uniform(-7, 7, *n)], -1)
    walkers, steps = _people(draw, foot, draw.chance(0.9, *n))
    side = 1 - 2.0 * draw.integers(2, *n)
    y = side * draw.uniform(1.2, 4.5, *n)
    long, wide, tall = (
        draw.uniform(1.6, 2.8, *n),
        draw.uniform(0.8, 1.1, *n),
        draw.uniform(0.6, 1.4, *n),
    )
    ones = torch.ones_like(long)
    half = torch.stack([
        torch.stack([long, wide, 0.45 * tall], -1),
        torch.stack([0.6 * long, 0.9 * wide, 0.35 * tall], -1),
        torch.stack([0.9 * long, 1.02 * wide, 0.15 * tall], -1),
    ], 2)  # fmt: skip
    height = torch.stack([0.3 + 0.45 * tall, 0.3 + 1.1 * tall, 0.15 + 0.15 * tall], -1)
    back = torch.stack([0 * long, -0.2 * long, 0 * long], -1)
    centre = torch.stack([x[..., None] + back, (y * ones)[..., None].expand_as(back), height], -1)
    kind = torch.full((*n, PARTS), BOX)
    rotation = about_z(draw.normal(0.05, *n))[:, :, None].expand(-1, -1, PARTS, -1, -1)
    ahead = draw.log_uniform(0.03, 3.0, *n) * torch.where(draw.chance(0.8, *n), -side, side)
    ways = torch.nn.functional.pad(ahead[..., None, None].expand(-1, -1, PARTS, -1), (0, 2))
    kind = torch.where(draw.chance(0.9, *n)[..., None], kind, NONE)
    cars = Solids(kind, rotation, centre, half).flatten()
    driving = draw.chance(0.65, *n).repeat_interleave(PARTS, 1)
    solids = chosen(driving, cars, walkers)
    ways = torch.where(driving[..., None], ways.flatten(1, 2), steps)
    solids = replace(solids, centre=scale * solids.centre + middle, half=scale * solids.half)
    return solids, scale * ways
