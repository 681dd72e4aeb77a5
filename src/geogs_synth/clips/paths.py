"""Candidate camera paths through random rooms; ``path_choice`` takes one."""

import math
from dataclasses import astuple, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.clips.room_options import MotionWeights, RoomOptions
from geogs_synth.draw import Draw, rotation_matrix


@dataclass(frozen=True)
class Paths:
    """k candidate paths of v views in each of b rooms."""

    R_wc: Float[Tensor, "b k v 3 3"]
    """Camera to world, OpenCV axes."""
    centre: Float[Tensor, "b k v 3"]
    """World, metres."""
    intrinsics: Float[Tensor, "b 4"]
    """fx fy cx cy in pixels."""
    crowd: Float[Tensor, "b"]
    """Fraction of the image that solids should fill."""


def draw_paths(draw: Draw, options: RoomOptions, size: Float[Tensor, "b 3"]) -> Paths:
    """Candidates anywhere in the rooms, without regard to the solids there."""
    b = len(size)
    k = options.candidates
    v = options.views
    start = draw.uniform(0, 1, b, k, 3) * (size - 0.4)[:, None] + 0.2
    start[..., 2] = torch.minimum(draw.uniform(0.4, 2.0, b, k), size[:, 2:] - 0.2)
    target = draw.uniform(0, 1, b, k, 3) * size[:, None]
    target[..., 2] = draw.uniform(0.05, 0.7, b, k) * size[:, 2:]
    forward = torch.nn.functional.normalize(target - start, dim=-1)
    roll = torch.where(draw.chance(0.1, b, k), draw.normal(0.5, b, k), draw.normal(0.06, b, k))
    R0 = looking(forward) @ rotation_matrix(torch.nn.functional.pad(roll[..., None], (2, 0)))
    translation, rotation, hold = _draw_steps(draw, options.motions, forward)

    # Longer clips go further, but each of their steps is shorter.
    progress = torch.arange(v) / max(math.sqrt(v - 1), 1.0)
    shaken = (v > 2) * (progress[:, None] > 0)
    steps = progress[:, None] + draw.normal(0.12, b, k, v, 1) * shaken
    centre = start[:, :, None] + steps * translation[:, :, None]
    if options.sway:
        aside = draw.normal(options.sway, b, k, v, 3) * shaken
        centre = centre + aside * translation.norm(dim=-1)[:, :, None, None]
    seen = start + forward * draw.log_uniform(0.8, 4.0, b, k)[..., None]
    jitter = draw.normal(0.1, b, k, v, 3) * shaken
    R = R0[:, :, None] @ rotation_matrix((steps + jitter) * rotation[:, :, None])
    R = _keep_in_view(R, centre, seen, start, hold)
    return Paths(R, centre, draw_intrinsics(draw, options, b), draw.uniform(0, 0.7, b))


def draw_intrinsics(draw: Draw, options: RoomOptions, rooms: int) -> Float[Tensor, "b 4"]:
    """Fields of view of 45 to 90 degrees, a principal point near the middle."""
    angle = draw.uniform(math.radians(45), math.radians(90), rooms)
    fx = 0.5 * options.width / (angle / 2).tan()
    fy = fx * (1 + draw.uniform(-0.02, 0.02, rooms))
    cx = 0.5 * (options.width - 1) + draw.uniform(-0.03, 0.03, rooms) * options.width
    cy = 0.5 * (options.height - 1) + draw.uniform(-0.03, 0.03, rooms) * options.height
    return torch.stack([fx, fy, cx, cy], -1)


def _draw_steps(
    draw: Draw, weights: MotionWeights, forward: Float[Tensor, "b k 3"]
) -> tuple[Float[Tensor, "b k 3"], Float[Tensor, "b k 3"], Float[Tensor, "b k"]]:
    """Motion of each candidate away from its first pose.

    Translation (metres, world frame), rotation vector (camera frame), and the fraction of the
    rotation that keeps the same point in view. All candidates of a room have one kind of motion,
    or some would be rarer.
    """
    b, k = forward.shape[:2]
    kind = draw.choose(astuple(weights), b)
    # Rows in the order of the weights: least and largest metres from view to view, largest degrees
    # about each axis, least and largest fraction of the rotation, 1 to move along the optical axis.
    kinds = torch.tensor(
        [
            [0.02, 0.15, 4.0, 0.0, 1.0, 0.0],
            [0.15, 0.5, 6.0, 0.2, 1.0, 0.0],
            [0.5, 1.2, 8.0, 0.7, 1.1, 0.0],
            [1e-4, 2e-4, 20.0, 0.0, 0.0, 0.0],
            [0.1, 0.8, 4.0, 0.0, 1.0, 1.0],
        ]
    )
    numbers = kinds[kind][:, None].expand(b, k, 6)
    low, high, degrees, hold_low, hold_high, along = numbers.unbind(-1)
    length = low * (high / low) ** draw.uniform(0, 1, b, k)
    sign = (1 - 2 * draw.integers(2, b, k))[..., None]
    axis = forward * sign + draw.normal(0.15, b, k, 3)
    direction = torch.where(along[..., None] > 0, axis, draw.normal(1.0, b, k, 3))
    translation = torch.nn.functional.normalize(direction, dim=-1) * length[..., None]
    rotation = draw.uniform(-1, 1, b, k, 3) * torch.tensor([1.0, 1.0, 0.5])
    rotation = rotation * (degrees * math.pi / 180)[..., None]
    hold = hold_low + (hold_high - hold_low) * draw.uniform(0, 1, b, k)
    return translation, rotation, hold


def _keep_in_view(
    R: Float[Tensor, "b k v 3 3"],
    centre: Float[Tensor, "b k v 3"],
    seen: Float[Tensor, "b k 3"],
    start: Float[Tensor, "b k 3"],
    hold: Float[Tensor, "b k"],
) -> Float[Tensor, "b k v 3 3"]:
    """Rotate views by a fraction of the rotation that keeps the point seen first at its pixel."""
    before = (seen - start)[:, :, None].expand_as(centre)
    now = torch.nn.functional.normalize(seen[:, :, None] - centre, dim=-1)
    before = torch.nn.functional.normalize(before, dim=-1)
    cross = torch.linalg.cross(before, now)
    sine = cross.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (before * now).sum(-1, keepdim=True))
    return rotation_matrix(cross / sine.clamp_min(1e-9) * angle * hold[..., None, None]) @ R


def looking(forward: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Camera to world of an upright camera with this viewing direction."""
    up = torch.zeros_like(forward)
    up[..., 2] = 1
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
