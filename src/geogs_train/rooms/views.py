"""Cameras in rooms: where their rays go and where points are in their images."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_Z = 0.01
"""Metres before a camera from where on points have a place in its image."""


@dataclass(frozen=True)
class Views:
    """Cameras: v views in each of b rooms."""

    T_cw: Float[Tensor, "b v 4 4"]
    """World to camera, OpenCV axes."""
    intrinsics: Float[Tensor, "b 4"]
    """fx fy cx cy in pixels, pixel centres at integers."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    @property
    def R_wc(self) -> Float[Tensor, "b v 3 3"]:
        """Camera to world."""
        return self.T_cw[..., :3, :3].transpose(-1, -2)

    @property
    def centre(self) -> Float[Tensor, "b v 3"]:
        """Of the cameras, world, metres."""
        return -(self.R_wc @ self.T_cw[..., :3, 3:])[..., 0]

    def packed(self) -> Float[Tensor, "b v 16"]:
        """What the kernels read: camera to world by rows, then the intrinsics."""
        pose = torch.cat([self.R_wc, self.centre[..., None]], -1).flatten(-2)
        k = self.intrinsics[:, None].expand(-1, pose.shape[1], -1)
        return torch.cat([pose, k], -1).float().contiguous()


def rays(
    views: Views, view: int, x: Float[Tensor, "m"], y: Float[Tensor, "m"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 3"]]:
    """Origins and directions (of unit z) of the rays through pixels, world frame."""
    fx, fy, cx, cy = views.intrinsics[:, :, None].unbind(1)
    d = torch.stack(torch.broadcast_tensors((x - cx) / fx, (y - cy) / fy, torch.ones_like(fx)), -1)
    direction = torch.einsum("bij,bmj->bmi", views.R_wc[:, view], d)
    return views.centre[:, view, None].expand_as(direction), direction


def project(
    views: Views, view: int, point: Float[Tensor, "b m 3"]
) -> tuple[Float[Tensor, "b m 2"], Bool[Tensor, "b m"]]:
    """Pixels of world points in a view, and which lie before its camera."""
    ray = point - views.centre[:, view, None]
    x, y, z = torch.einsum("bij,bmj->bmi", views.T_cw[:, view, :3, :3], ray).unbind(-1)
    fx, fy, cx, cy = views.intrinsics[:, :, None].unbind(1)
    safe = z.clamp_min(MIN_Z)
    return torch.stack([fx * x / safe + cx, fy * y / safe + cy], -1), z > MIN_Z


def pixel_grid(views: Views) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """x and y of all pixels, row after row."""
    k = views.intrinsics
    x, y = (torch.arange(n, dtype=k.dtype, device=k.device) for n in (views.width, views.height))
    return x.repeat(views.height), y.repeat_interleave(views.width)
