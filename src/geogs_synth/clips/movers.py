"""People and cars that move from view to view."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs_synth.clips.pieces import boxes
from geogs_synth.clips.street_clips import SCALE, placed_on_street
from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.batch import where
from geogs_synth.scene.solids import ELLIPSOID, FRUSTUM, NONE, SolidBatch, Solids

BODIES, PARTS = 4, 3
"""Bodies of a scene, solids of each; they are its last solids."""


def people(draw: Draw, size: Float[Tensor, "b 3"]) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    """Legs, trunk and head of people anywhere in rooms; the velocity of each, metres per view."""
    n = (len(size), BODIES)
    foot = draw.uniform(0.1, 0.9, *n, 2) * size[:, None, :2]
    there = draw.chance(0.85, *n)
    return _people(draw, foot, there)


def _people(
    draw: Draw, foot: Float[Tensor, "b k 2"], there: Bool[Tensor, "b k"]
) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    n = foot.shape[:2]
    tall, wide = draw.uniform(1.2, 1.95, *n), draw.uniform(0.13, 0.26, *n)
    x, y = foot.unbind(-1)
    parts = boxes(
        (x, y, 0.24 * tall, 0.6 * wide, 0.9 * wide, 0.24 * tall),
        (x, y, 0.65 * tall, 0.9 * wide, 1.1 * wide, 0.17 * tall),
        (x, y, 0.91 * tall, torch.tensor(0.09), torch.tensor(0.11), 0.08 * tall),
    )
    kind = torch.where(there[..., None], torch.tensor([FRUSTUM, FRUSTUM, ELLIPSOID]), NONE)
    lean = torch.nn.functional.pad(draw.normal(0.04, *n, PARTS, 2), (0, 1))
    rotation = about_z(draw.uniform(-3.15, 3.15, *n))[:, :, None].expand_as(parts.rotation)
    angle = draw.uniform(-3.15, 3.15, *n)
    pace = draw.log_uniform(0.01, 0.5, *n)[..., None] * torch.stack([angle.cos(), angle.sin()], -1)
    # Legs and head do not move quite like the trunk.
    velocity = pace[:, :, None] * draw.uniform(0.8, 1.2, *n, PARTS, 1)
    velocity = torch.nn.functional.pad(velocity, (0, 1))
    return Solids(kind, rotation, parts.centre + lean, parts.half).flatten(), velocity.flatten(1, 2)


def traffic(draw: Draw, scenes: int) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    """Cars on the roads of street clips, and pedestrians; their velocities, metres per view."""
    n = (scenes, BODIES)
    x = draw.uniform(-12, 60, *n) * (1 - 2.0 * draw.chance(0.3, *n))
    foot = torch.stack([x, draw.uniform(-7, 7, *n)], -1)
    walkers, walking = _people(draw, foot, draw.chance(0.9, *n))
    side = 1 - 2.0 * draw.integers(2, *n)
    y = side * draw.uniform(1.2, 4.5, *n)
    long, wide, tall = (draw.uniform(*r, *n) for r in ((1.6, 2.8), (0.8, 1.1), (0.6, 1.4)))
    parts = boxes(
        (x, y, 0.3 + 0.45 * tall, long, wide, 0.45 * tall),
        (x - 0.2 * long, y, 0.3 + 1.1 * tall, 0.6 * long, 0.9 * wide, 0.35 * tall),
        (x, y, 0.15 + 0.15 * tall, 0.9 * long, 1.02 * wide, 0.15 * tall),
    )
    rotation = about_z(draw.normal(0.05, *n))[:, :, None].expand_as(parts.rotation)
    ahead = draw.log_uniform(0.03, 3.0, *n) * torch.where(draw.chance(0.8, *n), -side, side)
    driving = torch.nn.functional.pad(ahead.repeat_interleave(PARTS, 1)[..., None], (0, 2))
    kind = torch.where(draw.chance(0.9, *n)[..., None], parts.kind, NONE)
    cars = replace(parts, kind=kind, rotation=rotation).flatten()
    is_car = draw.chance(0.65, *n).repeat_interleave(PARTS, 1)
    velocity = torch.where(is_car[..., None], driving, walking)
    return placed_on_street(where(is_car, cars, walkers)), SCALE * velocity
