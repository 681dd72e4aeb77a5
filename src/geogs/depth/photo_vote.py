"""Which of two depths the images of the neighbours speak for, pixel by pixel.

A window that is matched as a whole holds both surfaces at an edge, and a network guesses there. One
pixel holds one: seen from where it is, it has the same grey value in the neighbours. What single
pixels say is averaged over those around of the same colour, which are of the same surface (adaptive
support weights, Yoon and Kweon 2006).
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.depth_view import DepthView
from geogs.geometry.camera import Camera

DEVIATIONS = 3.0
"""Median deviations of a neighbour's grey values from which a difference counts in full: beyond two
standard deviations of the noise how large it is tells nothing."""
LEAST_DEVIATION = 0.5 / 255
"""Of grey values in [0, 1], which are rounded."""
RADIUS = 5
"""Pixels around that have a say."""
CONTRAST = 8 / 255
"""Mean difference of their colours by which their say falls to 1 / e."""


def photo_vote(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    depths: Float[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
) -> Float[Tensor, "h w"]:
    """How much better the images agree at the second depth than at the first, in [-1, 1].

    Args:
        reference: the view that the depths are of.
        neighbours: what it is compared with, at least one.
        depths: two depths of each pixel, z in map units.
        same: where both are of one surface, from which the neighbours' noise and light are learned.
        camera: of the depths and of the views' ``grey``.
    """
    guide, costs = pixel_costs(reference, neighbours, depths, same, camera)
    return averaged_by_colour(costs[0] - costs[1], guide)


def pixel_costs(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    depths: Float[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "2 h w"]]:
    """Colours of the reference in [0, 1], and how badly the neighbours' images agree at each of two
    depths, in [0, 1], of each pixel by itself; arguments as of :func:`photo_vote`."""
    device, size = depths.device, (camera.width, camera.height)
    grey = torch.from_numpy(np.stack([v.grey for v in (reference, *neighbours)])).to(device)
    poses = np.stack([v.T_cw for v in neighbours]) @ np.linalg.inv(reference.T_cw)
    differences = torch.stack(
        [seen_from(grey[1:], poses, depth, camera) - grey[0] for depth in depths]
    )
    colour = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA)
    guide = torch.from_numpy(colour).to(device).movedim(-1, 0).float() / 255
    return guide, best_half(truncated(differences, same))


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
    inside = (points[..., 2] > 0) & (x >= 0) & (y >= 0)
    inside &= (x <= camera.width - 1) & (y <= camera.height - 1)
    place = torch.stack([2 * x / (camera.width - 1) - 1, 2 * y / (camera.height - 1) - 1], -1)
    found = F.grid_sample(grey[:, None], place, align_corners=True, padding_mode="border")[:, 0]
    return torch.where(inside, found, torch.nan)


def truncated(
    differences: Float[Tensor, "2 n h w"], same: Bool[Tensor, "h w"]
) -> Float[Tensor, "2 n h w"]:
    """Differences of grey values without that of the light, over what each neighbour's noise makes
    of them, at most 1."""
    known = torch.where(same, differences[0], torch.nan).flatten(1)
    light = known.nanmedian(1).values.nan_to_num()
    deviation = (known - light[:, None]).abs().nanmedian(1).values.nan_to_num()
    most = DEVIATIONS * deviation.clamp(min=LEAST_DEVIATION)
    return ((differences - light[:, None, None]).abs() / most[:, None, None]).clamp(max=1)


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
