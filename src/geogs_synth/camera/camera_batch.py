"""Batches of cameras: rays through pixels and projection of points."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs_synth.draw import rotated

MIN_Z = 0.01
"""Least depth in metres of points that have a projection."""


@dataclass(frozen=True)
class CameraBatch:
    """v views in each of b rooms."""

    T_cw: Float[Tensor, "b v 4 4"]
    """World to camera, OpenCV axes."""
    intrinsics: Float[Tensor, "b 4"]
    """fx fy cx cy in pixels, pixel centres at integers."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    sweep: Float[Tensor, "b v 6"] | None = None
    """Motion of a camera from its first row to its last: rotation vector and translation (metres)
    in the frame of its middle row (that of ``T_cw``); None where all rows are read at once."""

    @property
    def R_wc(self) -> Float[Tensor, "b v 3 3"]:
        """Camera to world."""
        return self.T_cw[..., :3, :3].transpose(-1, -2)

    @property
    def centre(self) -> Float[Tensor, "b v 3"]:
        """Centres of the cameras, world, metres."""
        return -(self.R_wc @ self.T_cw[..., :3, 3:])[..., 0]

    def packed(self) -> Float[Tensor, "b v 24"]:
        """Kernel input: camera to world by rows, intrinsics, the motion during the readout, and
        the fraction of it from row to row."""
        pose = torch.cat([self.R_wc, self.centre[..., None]], -1).flatten(-2)
        k = self.intrinsics[:, None].expand(-1, pose.shape[1], -1)
        sweep = torch.zeros_like(pose[..., :6]) if self.sweep is None else self.sweep
        row = torch.zeros_like(pose[..., :2])
        row[..., 0] = 1 / max(self.height - 1, 1)
        return torch.cat([pose, k, sweep, row], -1).float().contiguous()

    def as_rooms(self) -> "CameraBatch":
        """One room for each view."""
        sweep = None if self.sweep is None else self.sweep.flatten(0, 1)[:, None]
        intrinsics = self.intrinsics.repeat_interleave(self.T_cw.shape[1], 0)
        return CameraBatch(
            self.T_cw.flatten(0, 1)[:, None], intrinsics, self.width, self.height, sweep
        )

    def row_fraction(self, y: Float[Tensor, "*rows"]) -> Float[Tensor, "*rows 1"]:
        """Time at which a row is read, from -1/2 to 1/2; a row may lie outside by half an image."""
        return (y / max(self.height - 1, 1) - 0.5).clamp(-1, 1)[..., None]

    def swept(self, view: int) -> tuple[Float[Tensor, "b 1 3"], Float[Tensor, "b 1 3"]]:
        """Rotation vector and translation of a view from its first row to its last."""
        assert self.sweep is not None
        rotation, translation = self.sweep[:, view, None].split(3, -1)
        return rotation, translation


def rays(
    views: CameraBatch, view: int, x: Float[Tensor, "m"], y: Float[Tensor, "m"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 3"]]:
    """Origins and directions (of unit z) of the rays through pixels, world frame."""
    fx, fy, cx, cy = views.intrinsics[:, :, None].unbind(1)
    d = torch.stack(torch.broadcast_tensors((x - cx) / fx, (y - cy) / fy, torch.ones_like(fx)), -1)
    centre = views.centre[:, view, None]
    if views.sweep is not None:
        fraction = views.row_fraction(y)
        (rotation, translation) = views.swept(view)
        d = rotated(d, fraction * rotation)
        centre = centre + torch.einsum("bij,bmj->bmi", views.R_wc[:, view], fraction * translation)
    direction = torch.einsum("bij,bmj->bmi", views.R_wc[:, view], d)
    return centre.expand_as(direction), direction


def project(
    views: CameraBatch, view: int, point: Float[Tensor, "b m 3"]
) -> tuple[Float[Tensor, "b m 2"], Bool[Tensor, "b m"]]:
    """Pixels of world points in a view, and which lie before its camera.

    The camera is that of the row that sees the point, found by a few rounds of projection.
    """
    ray = point - views.centre[:, view, None]
    middle = torch.einsum("bij,bmj->bmi", views.T_cw[:, view, :3, :3], ray)
    pixels, before = _pinhole(views, middle)
    if views.sweep is not None:
        rotation, translation = views.swept(view)
        for _ in range(8):  # each leaves a tenth of the error
            fraction = views.row_fraction(pixels[..., 1])
            in_row = rotated(middle - fraction * translation, -fraction * rotation)
            pixels, before = _pinhole(views, in_row)
    return pixels, before


def row_centre(
    views: CameraBatch, view: int, pixels: Float[Tensor, "b m 2"]
) -> Float[Tensor, "b m 3"]:
    """World position of the camera when the rows of these pixels are read."""
    centre = views.centre[:, view, None]
    if views.sweep is None:
        return centre.expand(*pixels.shape[:2], 3)
    translation = views.row_fraction(pixels[..., 1]) * views.swept(view)[1]
    return centre + torch.einsum("bij,bmj->bmi", views.R_wc[:, view], translation)


def _pinhole(
    views: CameraBatch, point: Float[Tensor, "b m 3"]
) -> tuple[Float[Tensor, "b m 2"], Bool[Tensor, "b m"]]:
    """Pixels of points in the frame of a camera, and which lie before it."""
    x, y, z = point.unbind(-1)
    fx, fy, cx, cy = views.intrinsics[:, :, None].unbind(1)
    safe = z.clamp_min(MIN_Z)
    return torch.stack([fx * x / safe + cx, fy * y / safe + cy], -1), z > MIN_Z


def pixel_grid(views: CameraBatch) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """x and y of all pixels, row after row."""
    k = views.intrinsics
    x, y = (torch.arange(n, dtype=k.dtype, device=k.device) for n in (views.width, views.height))
    return x.repeat(views.height), y.repeat_interleave(views.width)
