"""Camera with unknown focal length, radial terms and readout, with exact Jacobians.

All enter twice: in the ray of a source's cell and in its projection into the target.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import CellProjection, project, relative_motion
from geogs.geometry.camera import LEAST_SLOPE, Camera

UNIT = 0.01
"""Unit of the readout in the equations, seconds: it makes all unknowns of similar size."""


@dataclass(frozen=True)
class LensBlock:
    """A lens as a block of unknowns: log of the focal length, k1, k2, and the readout for a rolling
    shutter."""

    lens: Camera
    pixels: Float[Tensor, "p 2"]
    """Pixels of the cells."""
    focal: bool = True
    """Whether the focal length is a variable."""
    radial: bool = False
    """Whether k1 and k2 are variables."""
    readout: float = 0.0
    """Seconds from the first to the last row."""
    rolls: bool | None = None
    """Whether the readout is a variable; None for a global shutter, which has no such unknown."""

    @property
    def free(self) -> tuple[bool, ...]:
        """Whether each unknown is a variable."""
        of_rows = () if self.rolls is None else (self.rolls,)
        return self.focal, self.radial, self.radial, *of_rows

    @cached_property
    def rays(self) -> Float[Tensor, "p 3"]:
        """Rays of the cells, with z = 1."""
        x = self.lens.plane(self.pixels)
        return torch.cat([x, torch.ones_like(x[:, :1])], -1)

    @cached_property
    def slopes(self) -> Float[Tensor, "3 p"]:
        """Derivatives of the rays: d x / d log f, d x / d k1 and d x / d k2 are these factors times
        x; likewise for y."""
        square = self.rays[:, :2].square().sum(-1)
        by = torch.stack(self.lens.radial_shapes(square))
        return -by / self.lens.steepness(square).clamp(min=LEAST_SLOPE)

    def moved(self, step: Float[Tensor, "m"]) -> "LensBlock":
        """Return the block after a step of all unknowns, zero for those that are no variables."""
        *lens, longer = [*step.tolist(), 0.0][:4]
        return replace(self, lens=self.lens.moved(*lens), readout=self.readout + UNIT * longer)

    def project(
        self,
        T_cw: Float[Tensor, "n 4 4"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
        inverse_depth: Float[Tensor, "e p"],
    ) -> CellProjection:
        """Project the cells of the sources into the targets; depths are those of the sources."""
        T_ji = relative_motion(T_cw, source, target)
        return project(self.lens, self.rays, T_ji, inverse_depth)
