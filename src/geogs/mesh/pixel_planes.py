"""What each pixel of a depth map says of the surface there: a small plane, its footprint.

On a surface seen at a slant a footprint is longer than a voxel, and a distance along the ray is
many times that from the surface. Both follow from how inverse depth goes on around a pixel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.jumps import minmod_slopes

LEAST_BAND = 0.5
"""Fraction of the truncation that the band around a surface has along the normal at least, to
either side: a surface needs a voxel behind it wherever it passes the grid."""
_LEAST_INCIDENCE = 0.01
"""Nothing is taken for more slanted than that (89.4 degrees): it is a step that looks like one."""
_MOST_SAMPLES = 64
"""Along the footprint of a pixel."""


@dataclass(frozen=True)
class PixelPlanes:
    """The planes of all pixels of a depth map, by rows."""

    table: Float[Tensor, "p 4"]
    """Inverse depth, its slopes along u and v (1 / map unit / pixel) and the weight."""
    truncation: Float[Tensor, "p"]
    """Along the optical axis, map units."""

    @staticmethod
    def of(
        depth: Float[Tensor, "h w"],
        weight: Float[Tensor, "h w"],
        valid: Bool[Tensor, "h w"],
        camera: Camera,
        truncation: float,
    ) -> "PixelPlanes":
        """Inverse depth is linear along a plane, so its slopes are exact there at any slant.

        ``truncation`` (map units) is wider where it would leave less than :data:`LEAST_BAND` of it
        along the normal.
        """
        inverse = _inverse(depth, valid)
        right, down = minmod_slopes(inverse, valid)
        table = torch.stack([inverse, right, down, torch.where(valid, weight, 0.0)], -1)
        wider = (LEAST_BAND / _incidence(inverse, right, down, camera)).clamp(min=1)
        return PixelPlanes(table.flatten(0, 1), truncation * wider.flatten())


def widest(truncation: float) -> float:
    """The truncation along the axis of what is seen at the most slanted."""
    return truncation * max(1.0, LEAST_BAND / _LEAST_INCIDENCE)


def footprint_points(
    depth: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"], camera: Camera, spacing: float
) -> Float[Tensor, "n 3"]:
    """Points of the camera's frame along the footprints of the pixels, ``spacing`` apart or less.

    A pixel of a surface that faces the camera has one; one at a slant has more, up to 64, along
    the way on which its depth changes most.
    """
    inverse = _inverse(depth, valid)
    right, down = _slopes_around(*minmod_slopes(inverse, valid))
    steepest = torch.maximum(right.abs(), down.abs())
    length = steepest / inverse.square()
    count = (length / spacing).ceil().clamp(1, _MOST_SAMPLES)[valid].long()
    v, u = valid.nonzero().unbind(1)
    pixel = torch.arange(len(count), device=depth.device).repeat_interleave(count)
    number = torch.arange(len(pixel), device=depth.device) - (count.cumsum(0) - count)[pixel]
    along = (number + 0.5) / count[pixel] - 0.5
    unit = torch.where(steepest > 0, steepest, 1.0)[valid][pixel]
    right, down = right[valid][pixel], down[valid][pixel]
    du, dv = along * right / unit, along * down / unit
    z = 1 / (inverse[valid][pixel] + right * du + down * dv)
    x, y = (u[pixel] + du - camera.cx) / camera.fx, (v[pixel] + dv - camera.cy) / camera.fy
    return torch.stack([x * z, y * z, z], -1)


def _inverse(depth: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return torch.where(valid, 1.0 / torch.where(valid, depth, 1.0), 1.0)


def _incidence(
    inverse: Float[Tensor, "h w"],
    right: Float[Tensor, "h w"],
    down: Float[Tensor, "h w"],
    camera: Camera,
) -> Float[Tensor, "h w"]:
    """Distance from the plane over that along the axis: where 1 / z = a x + b y + c on the plane,
    (1 / z) / |(a, b, c)| on the ray (x, y, 1)."""
    right, down = _slopes_around(right, down)
    rays = camera.rays(inverse.dtype, inverse.device)
    a, b = right * camera.fx, down * camera.fy
    c = inverse - a * rays[..., 0] - b * rays[..., 1]
    return (inverse / torch.stack([a, b, c]).norm(dim=0)).clamp(min=_LEAST_INCIDENCE)


def _slopes_around(
    right: Float[Tensor, "h w"], down: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """The middle one of the slopes of three pixels in a row: a single pixel between two surfaces
    has a slope, but none that its neighbours have."""
    return _middle_of_three(right), _middle_of_three(down.mT).mT


def _middle_of_three(slope: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    before = torch.cat([slope[:, :1], slope[:, :-1]], 1)
    after = torch.cat([slope[:, 1:], slope[:, -1:]], 1)
    low, high = torch.minimum(before, after), torch.maximum(before, after)
    return torch.maximum(low, torch.minimum(slope, high))
