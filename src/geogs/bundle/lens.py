"""The camera with unknowns: one focal length and one radial term, with exact Jacobians.

Both enter twice: in the ray of a source's cell and in its projection into the target. Pixel =
c + F x (1 + k1 |x|^2), x = (X / Z, Y / Z), which is OpenCV's model with k1 alone.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import CellProjection, motion_rows, relative_motion, seen_from_targets
from geogs.bundle.terms import SharedProjection
from geogs.geometry.camera import Camera

_NEWTON_STEPS = 8
_LEAST_SLOPE = 0.1
"""Distorted radius per radius, below which the lens folds the image over."""


@dataclass(frozen=True)
class RadialLens:
    """A pinhole behind one radial term; the aspect and the principal point are known."""

    camera: Camera
    k1: float = 0.0

    def moved(self, log_focal: float, k1: float = 0.0) -> "RadialLens":
        """With the focal length times ``exp(log_focal)`` and ``k1`` added to the radial term."""
        c, factor = self.camera, math.exp(log_focal)
        return RadialLens(replace(c, fx=c.fx * factor, fy=c.fy * factor), self.k1 + k1)


@dataclass(frozen=True)
class LensBlock:
    """A lens as a block of unknowns: log of the focal length, and k1."""

    lens: RadialLens
    pixels: Float[Tensor, "p 2"]
    """Pixels of the cells."""
    focal: bool = True
    """Whether the focal length is a variable."""
    radial: bool = False
    """Whether k1 is a variable."""
    largest_step: ClassVar[float] = 0.3

    @property
    def free(self) -> tuple[bool, bool]:
        """As in the protocol."""
        return self.focal, self.radial

    @cached_property
    def rays(self) -> "LensRays":
        """Rays of the cells."""
        return lens_rays(self.lens, self.pixels)

    def moved(self, step: Float[Tensor, "2"]) -> "LensBlock":
        """As in the protocol."""
        return replace(self, lens=self.lens.moved(float(step[0]), float(step[1])))

    def project(
        self,
        T_cw: Float[Tensor, "n 4 4"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> CellProjection:
        """As in the protocol."""
        T_ji = relative_motion(T_cw, source, target)
        y, valid, z = seen_from_targets(self.rays.rays, T_ji, inverse_depth)
        return CellProjection(_to_pixels(self.lens, y[..., :2] / z[..., None]), valid, z)

    def linearise(
        self,
        T_cw: Float[Tensor, "n 4 4"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> SharedProjection:
        """As in the protocol."""
        lens, rays, T_ji = self.lens, self.rays, relative_motion(T_cw, source, target)
        y, valid, z = seen_from_targets(rays.rays, T_ji, inverse_depth)
        x, c, q = y[..., :2] / z[..., None], lens.camera, 1 / z
        u, v = x.unbind(-1)
        R, t = T_ji[:, :3, :3].to(inverse_depth), T_ji[:, :3, 3].to(inverse_depth)
        tx, ty, tz = t[:, None].unbind(-1)
        # A change of the lens moves the ray by a factor of (x, y, 0).
        ray = (rays.rays[:, :2] @ R[:, :, :2].mT).unbind(-1)
        along_x, along_y = (ray[0] - ray[2] * u) * q, (ray[1] - ray[2] * v) * q
        row_x = [along_x * rays.slope[0], along_x * rays.slope[1], (tx - tz * u) * q]
        row_y = [along_y * rays.slope[0], along_y * rays.slope[1], (ty - tz * v) * q]
        others = torch.stack([torch.stack(row_x, 1), torch.stack(row_y, 1)], 2)
        J = torch.cat([torch.stack(motion_rows(u, v, inverse_depth * q), 2), others], 1)
        square = u * u + v * v
        if lens.k1:
            point = x.mT[:, None]
            inward = (J * point).sum(2, keepdim=True)
            J = J * (1 + lens.k1 * square)[:, None, None] + 2 * lens.k1 * point * inward
        J = J * J.new_tensor([c.fx, c.fy])[:, None]
        pixels = _to_pixels(lens, x)
        centred = (pixels - pixels.new_tensor([c.cx, c.cy])).mT
        bulge = (x * pixels.new_tensor([c.fx, c.fy])).mT * square[:, None]
        own = [(J[:, 6] + centred)[:, None], (J[:, 7] + bulge)[:, None]]
        return SharedProjection(pixels, valid, z, torch.cat([J[:, :6], *own], 1), J[:, 8])


@dataclass(frozen=True)
class LensRays:
    """Rays of pixels, with what a change of the lens does to them."""

    rays: Float[Tensor, "p 3"]
    """z = 1."""
    slope: Float[Tensor, "2 p"]
    """d x / d log f and d x / d k1 are these factors times x, and alike for y."""


def lens_rays(lens: RadialLens, pixels: Float[Tensor, "p 2"]) -> LensRays:
    """Undistort pixels: Newton's method on the radius, s (1 + k1 s^2) = s_distorted."""
    c, k1 = lens.camera, lens.k1
    centre, focal = pixels.new_tensor([c.cx, c.cy]), pixels.new_tensor([c.fx, c.fy])
    distorted = (pixels - centre) / focal
    radius = distorted.norm(dim=-1)
    s = radius
    for _ in range(_NEWTON_STEPS if k1 else 0):
        s = s - (s + k1 * s**3 - radius) / (1 + 3 * k1 * s.square()).clamp(min=_LEAST_SLOPE)
    square = s.square()
    growth = 1 + k1 * square
    x = distorted / growth[:, None]
    steep = (1 + 3 * k1 * square).clamp(min=_LEAST_SLOPE)
    return LensRays(
        torch.cat([x, torch.ones_like(x[:, :1])], -1),
        torch.stack([-growth / steep, -square / steep]),
    )


def _to_pixels(lens: RadialLens, x: Float[Tensor, "e p 2"]) -> Float[Tensor, "e p 2"]:
    c = lens.camera
    growth = 1 + lens.k1 * x.square().sum(-1, keepdim=True)
    return x * growth * x.new_tensor([c.fx, c.fy]) + x.new_tensor([c.cx, c.cy])
