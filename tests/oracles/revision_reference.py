"""Which of two depths the images speak for, and the farther surface beside a pixel, in tensors."""

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.cuda.revision import offset_and_limit
from geogs.depth.depth_view import DepthView, relative_poses
from geogs.depth.revision.photo_vote import CONTRAST, RADIUS
from geogs.depth.revision.revised_searches import MIN_GAP, as_depth, inverse_planes
from geogs.geometry.camera import Camera

_AROUND = [step for step in product((-1, 0, 1), repeat=2) if step != (0, 0)]


def photo_costs(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    depths: Float[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
    mask: Bool[Tensor, "h w"] | None = None,
) -> Float[Tensor, "2 h w"]:
    """:func:`geogs.depth.revision.photo_vote.photo_costs` of all pixels."""
    if mask is not None:
        depths = torch.stack([depths[0], torch.where(mask, depths[1], depths[0])])
    device, size = depths.device, (camera.width, camera.height)
    grey = torch.from_numpy(np.stack([v.grey for v in (reference, *neighbours)])).to(device)
    poses = relative_poses(reference, neighbours)
    differences = torch.stack(
        [seen_from(grey[1:], poses, depth, camera) - grey[0] for depth in depths]
    )
    colour = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA)
    guide = torch.from_numpy(colour).to(device).movedim(-1, 0).float() / 255
    costs = averaged_by_colour(best_half(truncated(differences, same)), guide)
    return costs if mask is None else torch.where(mask, costs, 0.0)


def seen_from(
    grey: Float[Tensor, "n h w"],
    poses: Float[np.ndarray, "n 4 4"],
    depth: Float[Tensor, "h w"],
    camera: Camera,
) -> Float[Tensor, "n h w"]:
    """The neighbours' grey values where they see the pixels of a depth map; not a number outside.

    ``poses`` take the frame of the depth map to the neighbours'.
    """
    T = torch.from_numpy(poses).to(depth)
    points = camera.back_project(depth) @ T[:, None, :3, :3].mT + T[:, None, None, :3, 3]
    z = points[..., 2].clamp(min=1e-9)
    x = camera.fx * points[..., 0] / z + camera.cx
    y = camera.fy * points[..., 1] / z + camera.cy
    inside = (depth > 0) & (points[..., 2] > 0) & (x >= 0) & (y >= 0)
    inside &= (x <= camera.width - 1) & (y <= camera.height - 1)
    place = torch.stack([2 * x / (camera.width - 1) - 1, 2 * y / (camera.height - 1) - 1], -1)
    found = F.grid_sample(grey[:, None], place, align_corners=True, padding_mode="border")[:, 0]
    return torch.where(inside, found, torch.nan)


def truncated(
    differences: Float[Tensor, "2 n h w"], same: Bool[Tensor, "h w"]
) -> Float[Tensor, "2 n h w"]:
    """Grey differences less each neighbour's offset, over its limit, and at most 1."""
    offset, limit = offset_and_limit(differences[0], same)
    return ((differences - offset[:, None, None]).abs() / limit[:, None, None]).clamp(max=1)


def best_half(costs: Float[Tensor, "*b n h w"]) -> Float[Tensor, "*b h w"]:
    """The mean of each pixel's lower half, without those that are not numbers: in the other
    neighbours it may be hidden. 1 where there is none."""
    ordered = costs.nan_to_num(torch.inf).sort(-3).values
    count = (~costs.isnan()).sum(-3, keepdim=True)
    half = (count + 1) // 2
    rank = torch.arange(costs.shape[-3], device=costs.device)[:, None, None]
    total = torch.where(rank < half, ordered, 0.0).sum(-3)
    return torch.where(count[..., 0, :, :] > 0, total / half[..., 0, :, :].clamp(min=1), 1.0)


def averaged_by_colour(
    values: Float[Tensor, "*b h w"], guide: Float[Tensor, "3 h w"]
) -> Float[Tensor, "*b h w"]:
    """Each pixel's mean over those within ``RADIUS``, weighted by their likeness in colour."""
    height, width = values.shape[-2:]
    sides = (RADIUS,) * 4
    around = F.pad(values.reshape(1, -1, height, width), sides, mode="replicate")[0]
    around = around.reshape(*values.shape[:-2], *around.shape[1:])
    colours = F.pad(guide[None], sides, mode="replicate")[0]
    total, weights = torch.zeros_like(values), torch.zeros_like(guide[0])
    for dy in range(2 * RADIUS + 1):
        for dx in range(2 * RADIUS + 1):
            rows, columns = slice(dy, dy + height), slice(dx, dx + width)
            apart = (colours[:, rows, columns] - guide).abs().mean(0)
            weight = (apart * (-1 / CONTRAST)).exp()
            total += weight * around[..., rows, columns]
            weights += weight
    return total / weights


def farther_surface(depth: Float[Tensor, "h w"], reach: int) -> Float[Tensor, "h w"]:
    """As :func:`geogs.depth.revision.revised_searches.farther_surface`, all pixels at once."""
    source = inverse_planes(depth)
    inverse, found = source[0], torch.zeros_like(source)
    (height, width), farthest = depth.shape, inverse.amin()
    for _ in range(reach):
        around = F.pad(source, (1, 1, 1, 1))
        for dy, dx in _AROUND:
            plane = around[:, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
            here = plane[0] - dx * plane[1] - dy * plane[2]
            goes_on = (plane[0] > 0) & (here >= farthest) & (here < (1 - MIN_GAP) * inverse)
            new = goes_on & (found[0] == 0)
            found = torch.where(new, torch.stack([here, plane[1], plane[2]]), found)
        source = found
    return as_depth(found[0])
