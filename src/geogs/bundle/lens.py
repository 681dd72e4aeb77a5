"""The camera with unknowns: one focal length and two radial terms, with exact Jacobians.

All enter twice: in the ray of a source's cell and in its projection into the target. Pixel =
c + F x (1 + k1 |x|^2 + k2 |x|^4), x = (X / Z, Y / Z), which is OpenCV's model with k1 and k2 alone.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import CellProjection, relative_motion, seen_from_targets
from geogs.geometry.camera import Camera

_NEWTON_STEPS = 8
_LEAST_SLOPE = 0.1
"""Distorted radius per radius, below which the lens folds the image over."""


@dataclass(frozen=True)
class RadialLens:
    """A pinhole behind radial terms; the aspect and the principal point are known."""

    camera: Camera
    k1: float = 0.0
    k2: float = 0.0

    def moved(self, log_focal: float, k1: float = 0.0, k2: float = 0.0) -> "RadialLens":
        """With the focal length times ``exp(log_focal)``, ``k1`` and ``k2`` added to the terms."""
        c, factor = self.camera, math.exp(log_focal)
        camera = replace(c, fx=c.fx * factor, fy=c.fy * factor)
        return RadialLens(camera, self.k1 + k1, self.k2 + k2)

    def growth(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Factor on a ray's distance from the axis, whose square is given."""
        return 1 + square * (self.k1 + square * self.k2)

    def steepness(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Slope of the distorted radius over the radius: 1 + 3 k1 r^2 + 5 k2 r^4, at the least
        ``_LEAST_SLOPE``."""
        return (1 + square * (3 * self.k1 + 5 * square * self.k2)).clamp(min=_LEAST_SLOPE)


@dataclass(frozen=True)
class LensBlock:
    """A lens as a block of unknowns: log of the focal length, k1 and k2."""

    lens: RadialLens
    pixels: Float[Tensor, "p 2"]
    """Pixels of the cells."""
    focal: bool = True
    """Whether the focal length is a variable."""
    radial: bool = False
    """Whether k1 and k2 are variables."""

    @property
    def free(self) -> tuple[bool, bool, bool]:
        """Whether each unknown is a variable."""
        return self.focal, self.radial, self.radial

    @cached_property
    def rays(self) -> "LensRays":
        """Rays of the cells."""
        return lens_rays(self.lens, self.pixels)

    def moved(self, step: Float[Tensor, "3"]) -> "LensBlock":
        """The block after a step of all unknowns, zero for those that are no variables."""
        return replace(self, lens=self.lens.moved(*step.tolist()))

    def project(
        self,
        T_cw: Float[Tensor, "n 4 4"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> CellProjection:
        """Where the cells of the sources fall in the targets; depths are those of the sources."""
        T_ji = relative_motion(T_cw, source, target)
        y, valid, z = seen_from_targets(self.rays.rays, T_ji, inverse_depth)
        x, c = y[..., :2] / z[..., None], self.lens.camera
        growth = self.lens.growth(x.square().sum(-1, keepdim=True))
        pixels = x * growth * x.new_tensor([c.fx, c.fy]) + x.new_tensor([c.cx, c.cy])
        return CellProjection(pixels, valid, z)


@dataclass(frozen=True)
class LensRays:
    """Rays of pixels, with what a change of the lens does to them."""

    rays: Float[Tensor, "p 3"]
    """z = 1."""
    slope: Float[Tensor, "3 p"]
    """d x / d log f, d x / d k1 and d x / d k2 are these factors times x, and alike for y."""


def lens_rays(lens: RadialLens, pixels: Float[Tensor, "p 2"]) -> LensRays:
    """Undistort pixels: Newton's method on the radius, s (1 + k1 s^2 + k2 s^4) = s_distorted."""
    c = lens.camera
    centre, focal = pixels.new_tensor([c.cx, c.cy]), pixels.new_tensor([c.fx, c.fy])
    distorted = (pixels - centre) / focal
    radius = distorted.norm(dim=-1)
    s = radius
    for _ in range(_NEWTON_STEPS if lens.k1 or lens.k2 else 0):
        square = s.square()
        s = s - (s * lens.growth(square) - radius) / lens.steepness(square)
    square = s.square()
    growth, steep = lens.growth(square), lens.steepness(square)
    x = distorted / growth[:, None]
    slope = torch.stack([-growth / steep, -square / steep, -square.square() / steep])
    return LensRays(torch.cat([x, torch.ones_like(x[:, :1])], -1), slope)
