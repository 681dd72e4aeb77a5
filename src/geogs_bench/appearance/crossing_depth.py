"""Depth maps of coloured disks: the crossing of each pixel's ray with its median disk."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs.mesh.triangle_mesh import DepthMapView
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import AppearanceDisks
from geogs_bench.appearance.rasteriser import MIN_ALPHA, PIXEL_SHARPNESS, MedianDisks, Rasteriser
from geogs_bench.appearance.training_views import TrainingView

_MIN_FACING = 0.1
"""Smallest cosine between a ray and a disk's normal for which they are crossed."""
_DEVIATIONS = 3.0
"""Largest distance of a crossing from the centre, in the disk's larger standard deviations ..."""
_PIXELS = math.sqrt(-2 * math.log(MIN_ALPHA) / PIXEL_SHARPNESS)
"""... and, added to it, in pixels: the visible radius of the smallest disk."""


@torch.no_grad()
def crossing_depth(
    disks: AppearanceDisks,
    median: MedianDisks,
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    min_alpha: float,
) -> Float[Tensor, "h w"]:
    """z of the ray's crossing with the plane of the median disk; 0 below ``min_alpha``.

    The plane counts also where the pixel sees the disk only because none shrinks below a pixel:
    for disks of a pixel that is most of the image, and the centre's depth would make it a
    staircase. The centre's depth is taken where ray and plane are nearly parallel and where the
    crossing is farther from the centre than the disk can be seen.
    """
    has_depth = (median.index >= 0) & (median.alpha >= min_alpha)
    rows = median.index[has_depth]
    rays = camera.rays(torch.float32, disks.means.device)[has_depth]
    z = _crossing(disks, rows, rays, camera, T_cw)
    depth = torch.zeros(median.index.shape, device=disks.means.device)
    depth[has_depth] = z
    return depth


@torch.no_grad()
def depth_views(
    disks: AppearanceDisks,
    views: Sequence[TrainingView],
    rasteriser: Rasteriser,
    config: AppearanceConfig,
) -> list[DepthMapView]:
    """Depth of every view inside its mask; every pixel with a depth has weight 1."""
    device = disks.means.device
    maps = []
    for view in views:
        T_cw = torch.from_numpy(view.T_cw).float().to(device)
        median = rasteriser.median_disks(disks, view.camera, T_cw)
        depth = crossing_depth(disks, median, view.camera, T_cw, config.min_alpha)
        if view.mask is not None:
            depth = torch.where(torch.from_numpy(view.mask).to(device), depth, 0.0)
        weight = (depth > 0).float()
        T_cw_exact = torch.from_numpy(view.T_cw)
        maps.append(DepthMapView(depth, weight, view.camera, T_cw_exact, view.image))
    return maps


def _crossing(
    disks: AppearanceDisks,
    rows: Tensor,
    rays: Float[Tensor, "m 3"],
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
) -> Float[Tensor, "m"]:
    normal = quaternion_to_matrix(disks.quaternions)[..., 2] @ T_cw[:3, :3].T
    normal = normal[rows]
    centre = (disks.means @ T_cw[:3, :3].T + T_cw[:3, 3])[rows]
    facing = (rays * normal).sum(-1)
    is_seen_flat = facing.abs() > _MIN_FACING * rays.norm(dim=-1)
    z = (centre * normal).sum(-1) / torch.where(is_seen_flat, facing, 1.0)
    distance = (z[:, None] * rays - centre).norm(dim=-1)
    pixel = centre[:, 2] / min(camera.fx, camera.fy)
    reach = _DEVIATIONS * disks.scales.amax(1)[rows] + _PIXELS * pixel
    return torch.where(is_seen_flat & (distance <= reach) & (z > 0), z, centre[:, 2])
