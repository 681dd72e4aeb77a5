"""Where cameras are in random rooms and how they move: the first good one of many candidates."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.train.rooms.draw import Draw, from_vector
from geogs.train.rooms.options import RoomOptions
from geogs.train.rooms.raycast import entry, signed_distance, wall_distance
from geogs.train.rooms.render import Views
from geogs.train.rooms.scene import Solids

_CLEARANCE = 0.15
"""Metres between a camera and everything."""
_LEAST_SHARED = 0.5
"""Share of a view's points that the next view must have in its image."""
_FAN = (6, 5)
"""Rays across and down that say what a candidate sees."""
_NEAREST, _MEAN_DEPTH = 0.25, (0.5, 6.0)


@dataclass(frozen=True)
class _Motion:
    """What a kind of motion draws from."""

    length: tuple[float, float]
    """Metres between two views."""
    turn: float
    """Largest rotation about each axis, degrees."""
    hold: tuple[float, float]
    """Share of the turn that keeps the same point in view."""
    along_axis: float
    """0 moves anyhow, 1 along the optical axis."""


_KINDS = (
    _Motion((0.02, 0.15), 4.0, (0.0, 1.0), 0.0),
    _Motion((0.15, 0.5), 6.0, (0.2, 1.0), 0.0),
    _Motion((0.5, 1.2), 8.0, (0.7, 1.1), 0.0),
    _Motion((1e-4, 2e-4), 20.0, (0.0, 0.0), 0.0),
    _Motion((0.1, 0.8), 4.0, (0.0, 1.0), 1.0),
)
"""In the order of :class:`MotionShares`."""


@dataclass(frozen=True)
class _Paths:
    """k candidate paths of v views in each of b rooms."""

    R_wc: Float[Tensor, "b k v 3 3"]
    centre: Float[Tensor, "b k v 3"]


def draw_cameras(
    draw: Draw, options: RoomOptions, size: Float[Tensor, "b 3"], solids: Solids
) -> Views:
    """A clip in each room: clear of everything, and consecutive views share what they see."""
    intrinsics = _draw_intrinsics(draw, options, len(size))
    paths = _draw_paths(draw, options, size)
    clear = _clearance(paths, size, solids)
    good = (clear > _CLEARANCE) & _sees_enough(paths, options, size, solids, intrinsics)
    order = torch.arange(options.candidates, device=size.device)
    # Where none is good, the freest is taken; what is still too near to it is taken away later.
    best = torch.where(good, 100.0 - order, clear.clamp(-10, 10)).argmax(1)
    rows = torch.arange(len(size), device=size.device)
    R_cw, centre = paths.R_wc[rows, best].transpose(-1, -2), paths.centre[rows, best]
    T_cw = torch.eye(4, device=size.device).repeat(*R_cw.shape[:2], 1, 1)
    T_cw[..., :3, :3] = R_cw
    T_cw[..., :3, 3] = -(R_cw @ centre[..., None])[..., 0]
    return Views(T_cw, intrinsics, options.width, options.height)


def too_near(solids: Solids, views: Views) -> Bool[Tensor, "b n"]:
    """Solids that leave one of the views too little room."""
    return (signed_distance(solids, views.centre) < 0.9 * _CLEARANCE).any(1)


def _draw_intrinsics(draw: Draw, options: RoomOptions, rooms: int) -> Float[Tensor, "b 4"]:
    angle = draw.uniform(math.radians(45), math.radians(90), rooms)
    fx = 0.5 * options.width / (angle / 2).tan()
    fy = fx * (1 + draw.uniform(-0.02, 0.02, rooms))
    cx = 0.5 * (options.width - 1) + draw.uniform(-0.03, 0.03, rooms) * options.width
    cy = 0.5 * (options.height - 1) + draw.uniform(-0.03, 0.03, rooms) * options.height
    return torch.stack([fx, fy, cx, cy], -1)


def _draw_paths(draw: Draw, options: RoomOptions, size: Float[Tensor, "b 3"]) -> _Paths:
    b, k, v = len(size), options.candidates, options.views
    start = draw.uniform(0, 1, b, k, 3) * (size - 0.4)[:, None] + 0.2
    start[..., 2] = torch.minimum(draw.uniform(0.4, 2.0, b, k), size[:, 2:] - 0.2)
    target = draw.uniform(0, 1, b, k, 3) * size[:, None]
    target[..., 2] = draw.uniform(0.05, 0.75, b, k) * size[:, 2:]
    forward = torch.nn.functional.normalize(target - start, dim=-1)
    roll = torch.where(draw.chance(0.1, b, k), draw.normal(0.5, b, k), draw.normal(0.06, b, k))
    R0 = _looking(forward) @ from_vector(torch.nn.functional.pad(roll[..., None], (2, 0)))

    kinds = _choose_motion(draw, options, b)
    low, high, turn, hold_low, hold_high, along = kinds[:, None].expand(b, k, 6).unbind(-1)
    length = low * (high / low) ** draw.uniform(0, 1, b, k)
    way = torch.nn.functional.normalize(draw.normal(1.0, b, k, 3), dim=-1)
    axis = torch.nn.functional.normalize(
        forward * (1 - 2 * draw.integers(2, b, k))[..., None] + draw.normal(0.15, b, k, 3), dim=-1
    )
    way = torch.where(along[..., None] > 0, axis, way)
    spin = draw.uniform(-1, 1, b, k, 3) * torch.tensor([1.0, 1.0, 0.5], device=size.device)
    spin = spin * (turn * math.pi / 180)[..., None]
    hold = hold_low + (hold_high - hold_low) * draw.uniform(0, 1, b, k)

    # Longer clips go further, but each of their steps is shorter.
    progress = torch.arange(v, device=size.device) / max(math.sqrt(v - 1), 1.0)
    shake = draw.normal(0.12, b, k, v, 1) * (v > 2) * (progress[:, None] > 0)
    steps = progress[:, None] + shake
    centre = start[:, :, None] + steps * (length[..., None] * way)[:, :, None]
    seen = start + forward * draw.log_uniform(0.8, 4.0, b, k)[..., None]
    jitter = draw.normal(0.1, b, k, v, 3) * (v > 2) * (progress[:, None] > 0)
    R = R0[:, :, None] @ from_vector((steps + jitter) * spin[:, :, None])
    return _Paths(_keep_in_view(R, centre, seen, R0, start, hold), centre)


def _choose_motion(draw: Draw, options: RoomOptions, rooms: int) -> Float[Tensor, "b 6"]:
    """The numbers of a kind of motion for each room."""
    shares = options.motions
    kind = draw.choose(
        (shares.hand_held, shares.medium, shares.wide, shares.rotation, shares.forward), rooms
    )
    rows = [[*m.length, m.turn, *m.hold, m.along_axis] for m in _KINDS]
    return torch.tensor(rows, device=draw.device)[kind]


def _keep_in_view(
    R: Float[Tensor, "b k v 3 3"], centre: Float[Tensor, "b k v 3"], seen: Float[Tensor, "b k 3"],
    R0: Float[Tensor, "b k 3 3"], start: Float[Tensor, "b k 3"], hold: Float[Tensor, "b k"],
) -> Float[Tensor, "b k v 3 3"]:  # fmt: skip
    """Turns views by the share ``hold`` of what brings the point seen first back to its pixel."""
    before = torch.einsum("bkij,bki->bkj", R0, seen - start)[:, :, None]
    now = torch.einsum("bkij,bkvi->bkvj", R0, seen[:, :, None] - centre)
    a = torch.nn.functional.normalize(before.expand_as(now), dim=-1)
    b = torch.nn.functional.normalize(now, dim=-1)
    cross = torch.linalg.cross(a, b)
    sine = cross.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (a * b).sum(-1, keepdim=True))
    vector = cross / sine.clamp_min(1e-9) * angle * hold[..., None, None]
    return R0[:, :, None] @ from_vector(vector) @ R0[:, :, None].transpose(-1, -2) @ R


def _looking(forward: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Camera to world for an upright camera that looks ahead like this."""
    up = torch.zeros_like(forward)
    up[..., 2] = 1
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], -1)


def _clearance(paths: _Paths, size: Float[Tensor, "b 3"], solids: Solids) -> Float[Tensor, "b k"]:
    """Least distance of a path's cameras to anything, metres."""
    b, k, v = paths.centre.shape[:3]
    points = paths.centre.flatten(1, 2)
    free = torch.minimum(signed_distance(solids, points).amin(-1), wall_distance(size, points))
    return free.reshape(b, k, v).amin(-1)


def _sees_enough(
    paths: _Paths, options: RoomOptions, size: Float[Tensor, "b 3"], solids: Solids,
    intrinsics: Float[Tensor, "b 4"],
) -> Bool[Tensor, "b k"]:  # fmt: skip
    """Whether what a path sees is at a fair distance, and stays in view from view to view."""
    b, k, v = paths.centre.shape[:3]
    directions = _fan(options, intrinsics)[:, None, None]
    r = directions.shape[3]
    ray = torch.einsum("bkvij,bkvrj->bkvri", paths.R_wc, directions.expand(b, k, v, r, 3))
    origin = paths.centre[..., None, :].expand_as(ray)
    flat = (b, k * v * r, 3)
    t = entry(solids, origin.reshape(flat), ray.reshape(flat)).amin(-1)
    room = torch.where(ray > 0, size[:, None, None, None] - origin, -origin) / ray
    depth = torch.minimum(t.reshape(b, k, v, r), room.amin(-1))
    mean = depth.mean(-1)
    fair = (depth.amin(-1) > _NEAREST) & (mean > _MEAN_DEPTH[0]) & (mean < _MEAN_DEPTH[1])
    shared = _share_in_next(paths, options, origin + depth[..., None] * ray, intrinsics)
    return fair.all(-1) & (shared > _LEAST_SHARED).all(-1)


def _fan(options: RoomOptions, intrinsics: Float[Tensor, "b 4"]) -> Float[Tensor, "b r 3"]:
    """Directions of a few rays spread over the image, camera frame."""
    across, down = _FAN
    device = intrinsics.device
    x = (torch.arange(across, device=device) + 0.5) / across * options.width
    y = (torch.arange(down, device=device) + 0.5) / down * options.height
    fx, fy, cx, cy = intrinsics[:, :, None].unbind(1)
    u, v = (x.repeat(down) - cx) / fx, (y.repeat_interleave(across) - cy) / fy
    return torch.stack([u, v, torch.ones_like(u)], -1)


def _share_in_next(
    paths: _Paths, options: RoomOptions, points: Float[Tensor, "b k v r 3"],
    intrinsics: Float[Tensor, "b 4"],
) -> Float[Tensor, "b k steps"]:  # fmt: skip
    """Share of each view's points that the next view has in its image."""
    offset = points[:, :, :-1] - paths.centre[:, :, 1:, None]
    x, y, z = torch.einsum("bkvij,bkvri->bkvrj", paths.R_wc[:, :, 1:], offset).unbind(-1)
    fx, fy, cx, cy = intrinsics[:, :, None, None, None].unbind(1)
    safe = z.clamp_min(0.1)
    u, v = fx * x / safe + cx, fy * y / safe + cy
    inside = (z > 0.1) & (u >= 0) & (v >= 0) & (u < options.width) & (v < options.height)
    return inside.float().mean(-1)
