"""The small plane that each pixel of a depth map shows, and its footprint.

On a surface seen at a slant a footprint is longer than a voxel, and a distance along the ray is
many times that from the surface. Both follow from the slopes of inverse depth around a pixel.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.jumps import minmod_slopes
from geogs.mesh.volume.contraction import Contraction

LEAST_BAND = 0.5
"""Least width of the band on either side of a surface, along the normal, as a fraction of the
truncation: a surface needs a voxel behind it wherever it passes the grid."""
_LEAST_INCIDENCE = 0.01
"""Least incidence (89.4 degrees): a surface that seems more slanted is a depth step."""
_MOST_SAMPLES = 64
"""Most samples along the footprint of a pixel."""
_GRAZING = 0.1
"""Incidence (84 degrees) below which a depth's weight falls with its square: of a road far ahead
the upper ends of disks are seen, by all earlier views alike."""
_LEAST_WEIGHT = 0.1
"""Least fraction of its weight that it keeps."""


@dataclass(frozen=True)
class PixelPlanes:
    """The planes of all pixels of a depth map.

    Inverse depth is linear along a plane, so its slopes are exact there at any slant.
    """

    inverse: Float[Tensor, "h w"]
    """Inverse depth; 1 where there is none."""
    right: Float[Tensor, "h w"]
    """Slope of inverse depth along u, per pixel; it reaches across no jump."""
    down: Float[Tensor, "h w"]
    """Slope along v."""
    slant: tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]
    """Median of three pixels in a row of both slopes: a single pixel between two surfaces has a
    slope that its neighbours do not have."""
    valid: Bool[Tensor, "h w"]
    """Pixels with a depth."""
    camera: Camera
    growth: Float[Tensor, "h w"] | float = 1.0
    """Factor at each pixel on lengths that follow the size of the voxels."""

    @staticmethod
    def of(
        depth: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"], camera: Camera
    ) -> "PixelPlanes":
        """Planes of depths in map units."""
        inverse = torch.where(valid, 1.0 / torch.where(valid, depth, 1.0), 1.0)
        right, down = minmod_slopes(inverse, valid)
        slant = _middle_of_three(right), _middle_of_three(down.mT).mT
        return PixelPlanes(inverse, right, down, slant, valid, camera)

    def table(self, weight: Float[Tensor, "h w"]) -> Float[Tensor, "p 4"]:
        """Inverse depth, its slopes along u and v and the weight, by rows.

        The weight is less where the surface is seen edge-on.
        """
        facing = (self._incidence / _GRAZING).square().clamp(_LEAST_WEIGHT, 1)
        weight = torch.where(self.valid, weight * facing, 0.0)
        return torch.stack([self.inverse, self.right, self.down, weight], -1).flatten(0, 1)

    def grown(self, T_cw: Float[Tensor, "4 4"], contraction: Contraction) -> "PixelPlanes":
        """The planes seen from a pose, in a world whose voxels grow with the contraction."""
        if not contraction:
            return self
        rays = self.camera.rays(torch.float64, self.inverse.device)
        points = (rays / self.inverse[..., None] - T_cw[:3, 3]) @ T_cw[:3, :3]
        return replace(self, growth=contraction.growth(points).to(self.inverse))

    def truncation(self, shortest: float) -> Float[Tensor, "p"]:
        """Truncation along the optical axis, map units, by rows.

        ``shortest``, but wider where that would leave less than :data:`LEAST_BAND` of it along the
        normal.
        """
        return (shortest * self.growth * (LEAST_BAND / self._incidence).clamp(min=1)).flatten()

    def footprints(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points of the camera's frame along the footprints of the pixels with a depth, ``spacing``
        (map units) apart or less.

        A pixel of a surface that faces the camera has one; one at a slant has more, up to 64, along
        the direction in which its depth changes most.
        """
        valid = self.valid
        camera = self.camera
        device = self.inverse.device
        steepest = torch.maximum(*(slope.abs() for slope in self.slant))
        length = steepest / self.inverse.square()
        count = (length / (spacing * self.growth)).ceil().clamp(1, _MOST_SAMPLES)[valid].long()
        v, u = valid.nonzero().unbind(1)
        pixel = torch.arange(len(count), device=device).repeat_interleave(count)
        number = torch.arange(len(pixel), device=device) - (count.cumsum(0) - count)[pixel]
        along = (number + 0.5) / count[pixel] - 0.5
        unit = torch.where(steepest > 0, steepest, 1.0)[valid][pixel]
        right, down = (slope[valid][pixel] for slope in self.slant)
        du, dv = along * right / unit, along * down / unit
        z = 1 / (self.inverse[valid][pixel] + right * du + down * dv)
        x, y = (u[pixel] + du - camera.cx) / camera.fx, (v[pixel] + dv - camera.cy) / camera.fy
        return torch.stack([x * z, y * z, z], -1)

    @cached_property
    def _incidence(self) -> Float[Tensor, "h w"]:
        """Ratio of the distance from the plane to that along the axis: with 1 / z = a x + b y + c
        on the plane, (1 / z) / |(a, b, c)| on the ray (x, y, 1)."""
        rays = self.camera.rays(self.inverse.dtype, self.inverse.device)
        a, b = self.slant[0] * self.camera.fx, self.slant[1] * self.camera.fy
        c = self.inverse - a * rays[..., 0] - b * rays[..., 1]
        return (self.inverse / torch.stack([a, b, c]).norm(dim=0)).clamp(min=_LEAST_INCIDENCE)


def widest(truncation: float) -> float:
    """The truncation along the axis on the most slanted surface."""
    return truncation * max(1.0, LEAST_BAND / _LEAST_INCIDENCE)


def _middle_of_three(slope: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    before = torch.cat([slope[:, :1], slope[:, :-1]], 1)
    after = torch.cat([slope[:, 1:], slope[:, -1:]], 1)
    low, high = torch.minimum(before, after), torch.maximum(before, after)
    return torch.maximum(low, torch.minimum(slope, high))
