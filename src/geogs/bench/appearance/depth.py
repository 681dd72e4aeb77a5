"""Depth of coloured disks: where each pixel's ray crosses its median disk."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bench.appearance.disks import AppearanceDisks
from geogs.bench.appearance.rasteriser import MedianDisks
from geogs.bench.appearance.reference import PIXEL_SHARPNESS
from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix

_MIN_FACING = 1e-6


@torch.no_grad()
def crossing_depth(
    disks: AppearanceDisks,
    median: MedianDisks,
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    min_alpha: float,
) -> Float[Tensor, "h w"]:
    """z of the ray's crossing with the median disk; 0 where alpha is below ``min_alpha``.

    Where the pixel sees a disk only because none shrinks below a pixel (seen from the side, or
    far away), the crossing may be anywhere, and the depth of the centre is taken (Huang et al.
    2024, Sec. 4.2).
    """
    has_depth = (median.index >= 0) & (median.alpha >= min_alpha)
    rows = median.index[has_depth]
    rays = camera.rays(torch.float32, disks.means.device)[has_depth]
    z = _crossing(disks, rows, rays, camera, T_cw)
    depth = torch.zeros(median.index.shape, device=disks.means.device)
    depth[has_depth] = z
    return depth


def _crossing(
    disks: AppearanceDisks,
    rows: Tensor,
    rays: Float[Tensor, "m 3"],
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
) -> Float[Tensor, "m"]:
    R = (T_cw[:3, :3] @ quaternion_to_matrix(disks.quaternions))[rows]
    centre = (disks.means @ T_cw[:3, :3].T + T_cw[:3, 3])[rows]
    facing = (rays * R[..., 2]).sum(-1)
    is_seen_flat = facing.abs() > _MIN_FACING
    z = (centre * R[..., 2]).sum(-1) / torch.where(is_seen_flat, facing, 1.0)
    hit = z[:, None] * rays - centre
    local = torch.einsum("mij,mi->mj", R[..., :2], hit) / disks.scales[rows]
    focal = rays.new_tensor([camera.fx, camera.fy])
    pixels = (rays[:, :2] - centre[:, :2] / centre[:, 2:]) * focal
    by_disk = local.square().sum(-1) <= PIXEL_SHARPNESS * pixels.square().sum(-1)
    return torch.where(is_seen_flat & by_disk & (z > 0), z, centre[:, 2])
