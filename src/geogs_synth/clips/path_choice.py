"""Choice of a candidate path: the first that keeps clear of everything and sees enough."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.clips.paths import Paths
from geogs_synth.raycast.caster_choice import caster_for
from geogs_synth.raycast.solid_distance import signed_distance, wall_distance
from geogs_synth.scene.solids import SolidBatch

_CLEARANCE = 0.15
"""Least distance between a camera and everything, metres."""
_LEAST_OVERLAP = 0.5
"""Least fraction of a view's points that the next view must have in its image."""
_FAN = (6, 5)
"""Rays across and down that measure the depths a candidate sees."""
_NEAREST, _MEAN_DEPTH = 0.25, (0.5, 6.0)
"""Least depth, and range of the mean depth, metres."""
_SKY = 12.0
"""Metres beyond which something is no part of a room and does not count as seen."""


@dataclass(frozen=True)
class _Sight:
    """Hits of a few rays of every view of the candidates."""

    depth: Float[Tensor, "b k v r"]
    points: Float[Tensor, "b k v r 3"]
    crowd: Float[Tensor, "b k"]
    """Fraction of the first view's rays that end on a solid."""


def choose_cameras(
    paths: Paths, size: Float[Tensor, "b 3"], solids: SolidBatch, width: int, height: int
) -> CameraBatch:
    """Choose the path from which each room is filmed; consecutive views overlap."""
    clear = _clearance(paths, size, solids)
    sight = _look(paths, size, solids, width, height)
    near = (sight.depth < _SKY).float()
    mean = (sight.depth * near).sum(-1) / near.sum(-1).clamp_min(1.0)
    fair = (sight.depth.amin(-1) > _NEAREST) & (mean > _MEAN_DEPTH[0]) & (mean < _MEAN_DEPTH[1])
    overlap = _overlap_with_next(paths, sight, width, height) > _LEAST_OVERLAP
    good = (clear > _CLEARANCE) & fair.all(-1) & overlap.all(-1)
    crowded = good & (sight.crowd >= paths.crowd[:, None])
    # Where none is good, take the freest; solids that are too near to it are removed later.
    order = torch.arange(clear.shape[1], device=size.device)
    rank = torch.where(good, 200.0 + 100.0 * sight.crowd, clear.clamp(-10, 10))
    best = torch.where(crowded, 1000.0 - order, rank).argmax(1)
    rows = torch.arange(len(size), device=size.device)
    R_cw = paths.R_wc[rows, best].transpose(-1, -2)
    centre = paths.centre[rows, best]
    T_cw = torch.eye(4, device=size.device).repeat(*R_cw.shape[:2], 1, 1)
    T_cw[..., :3, :3] = R_cw
    T_cw[..., :3, 3] = -(R_cw @ centre[..., None])[..., 0]
    return CameraBatch(T_cw, paths.intrinsics, width, height)


def too_near(solids: SolidBatch, views: CameraBatch) -> Bool[Tensor, "b n"]:
    """Solids that are too near to one of the views."""
    return (signed_distance(solids, views.centre) < 0.9 * _CLEARANCE).any(1)


def _clearance(
    paths: Paths, size: Float[Tensor, "b 3"], solids: SolidBatch
) -> Float[Tensor, "b k"]:
    """Least distance of a path's cameras to anything, metres."""
    b, k, v = paths.centre.shape[:3]
    points = paths.centre.flatten(1, 2)
    free = torch.minimum(signed_distance(solids, points).amin(-1), wall_distance(size, points))
    return free.reshape(b, k, v).amin(-1)


def _look(
    paths: Paths, size: Float[Tensor, "b 3"], solids: SolidBatch, width: int, height: int
) -> _Sight:
    directions = _fan(paths.intrinsics, width, height)[:, None, None]
    ray = (paths.R_wc[..., None, :, :] @ directions[..., None])[..., 0]
    origin = paths.centre[..., None, :].expand_as(ray)
    caster = caster_for(size.device)
    hit = caster.first_hit(size, solids, origin.flatten(1, 3), ray.flatten(1, 3))
    depth, solid = (x.reshape(ray.shape[:-1]) for x in (hit.t, hit.solid))
    crowd = (solid[:, :, 0] >= 0).float().mean(-1)
    return _Sight(depth, origin + depth[..., None] * ray, crowd)


def _fan(intrinsics: Float[Tensor, "b 4"], width: int, height: int) -> Float[Tensor, "b r 3"]:
    """Directions of a few rays spread over the image, camera frame."""
    across, down = _FAN
    device = intrinsics.device
    x = (torch.arange(across, device=device) + 0.5) / across * width
    y = (torch.arange(down, device=device) + 0.5) / down * height
    fx, fy, cx, cy = intrinsics[:, :, None].unbind(1)
    u, v = (x.repeat(down) - cx) / fx, (y.repeat_interleave(across) - cy) / fy
    return torch.stack([u, v, torch.ones_like(u)], -1)


def _overlap_with_next(
    paths: Paths, sight: _Sight, width: int, height: int
) -> Float[Tensor, "b k steps"]:
    """Fraction of each view's points that the next view has in its image."""
    offset = sight.points[:, :, :-1] - paths.centre[:, :, 1:, None]
    x, y, z = (offset[..., None, :] @ paths.R_wc[:, :, 1:, None])[..., 0, :].unbind(-1)
    fx, fy, cx, cy = paths.intrinsics[:, :, None, None, None].unbind(1)
    safe = z.clamp_min(0.1)
    u, v = fx * x / safe + cx, fy * y / safe + cy
    inside = (z > 0.1) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    return inside.float().mean(-1)
