"""Planes at many depths in the views of neighbours: projections and samples.

Everything here is float32: a coordinate in bfloat16 is wrong by pixels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

CELL = 4
"""Pixels per cell of the coarse features; cell i covers the pixels 4 i to 4 i + 3."""
LEAST_Z = 0.02
"""Depth in a neighbour, relative to the typical depth, below which nothing is seen."""


@dataclass(frozen=True)
class TriedDepths:
    """Depths tried in every cell of keyframes; logarithms are of depth over the typical depth."""

    log_depth: Float[Tensor, "b d #p"]
    """Logarithms of depth; the same for all cells if they are planes."""
    label: Float[Tensor, "b d"]
    """Network input for each depth."""
    step: Float[Tensor, "b"]
    """Approximate difference from one to the next."""
    cell: int = CELL
    """Pixels per cell."""

    @staticmethod
    def planes(log_planes: Float[Tensor, "b d"]) -> "TriedDepths":
        """Evenly spaced planes."""
        return TriedDepths(log_planes[..., None], log_planes, plane_step(log_planes))


@dataclass(frozen=True)
class PlaneViews:
    """The cells of keyframes, at every depth tried, in one neighbour each."""

    cells: Float[Tensor, "b d p 2"]
    """Position x, y in the neighbour, cells."""
    seen: Bool[Tensor, "b d p"]
    """Whether it is in front of the camera and in the image."""
    log_z: Float[Tensor, "b d p"]
    """Logarithm of the depth in the neighbour."""
    angle: Float[Tensor, "b d p"]
    """Angle between the two rays, radians."""
    log_step: Float[Tensor, "b d p"]
    """Logarithm of the pixels that a cell moves from this depth to the next."""


def plane_step(log_planes: Float[Tensor, "b d"]) -> Float[Tensor, "b"]:
    """Mean difference from one plane to the next."""
    return torch.diff(log_planes, dim=1).mean(1)


def log_planes(
    near: Float[Tensor, "b"], far: Float[Tensor, "b"], count: int
) -> Float[Tensor, "b d"]:
    """Logarithms of depths from near to far, evenly spaced."""
    fraction = torch.linspace(0, 1, count, dtype=near.dtype, device=near.device)
    return torch.lerp(near.log()[:, None], far.log()[:, None], fraction)


def cell_rays(
    intrinsics: Float[Tensor, "b 4"], height: int, width: int, cell: int = CELL
) -> Float[Tensor, "b 3 p"]:
    """K^-1 (x, y, 1) of the centres of cells of ``cell`` pixels, row by row."""
    fx, fy, cx, cy = intrinsics[:, :, None].unbind(1)
    middle = (cell - 1) / 2
    x = (cell * torch.arange(width, device=fx.device) + middle - cx) / fx
    y = (cell * torch.arange(height, device=fx.device) + middle - cy) / fy
    x, y = x[:, None].expand(-1, height, -1), y[:, :, None].expand(-1, -1, width)
    return torch.stack([x, y, torch.ones_like(x)], 1).flatten(2)


def see_planes(
    rays: Float[Tensor, "b 3 p"],
    tried: TriedDepths,
    T: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
    height: int,
    width: int,
) -> PlaneViews:
    """Cells at these depths in a neighbour of ``height`` x ``width`` cells.

    ``T`` takes points of the keyframe's camera to the neighbour's; its translation is divided by
    the typical depth.
    """
    rotated = T[:, :3, :3] @ rays
    z = tried.log_depth.exp()[:, None]
    point = z * rotated[:, :, None] + T[:, :3, 3, None, None]
    focal, centre = (intrinsics[:, k, None, None] for k in (slice(0, 2), slice(2, 4)))
    depth = point[:, 2]
    safe = depth.clamp_min(LEAST_Z)
    pixels = focal * (point[:, :2] / safe[:, None]) + centre
    # d pixel / d log z is z d pixel / dz.
    slope = rotated[:, :2, None] - point[:, :2] / safe[:, None] * rotated[:, 2:, None]
    moved = (focal * slope * (z / safe[:, None])).square().sum(1).sqrt()
    moved = moved * tried.step[:, None, None]
    cosine = (rotated[:, :, None] * point).sum(1) / (
        rays.norm(dim=1)[:, None] * point.square().sum(1).sqrt().clamp_min(1e-6)
    )
    cells = (pixels - (tried.cell - 1) / 2) / tried.cell
    x, y = cells.unbind(1)
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    seen = inside & (depth > LEAST_Z)
    angle = cosine.clamp(-1 + 1e-6, 1 - 1e-6).arccos()
    return PlaneViews(cells.movedim(1, -1), seen, safe.log(), angle, (moved + 1e-3).log())


def sample_cells(
    features: Float[Tensor, "b c h w"], cells: Float[Tensor, "b d p 2"]
) -> Float[Tensor, "b c d p"]:
    """Bilinear features at positions among the cells; zero outside."""
    height, width = features.shape[-2:]
    x, y = cells.unbind(-1)
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], -1)
    return functional.grid_sample(features, grid.clamp(-4, 4), align_corners=False)
