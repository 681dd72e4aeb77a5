"""Contraction of space far from the cameras, so that one grid suits near and far surfaces.

The error of a depth from two views grows with the square of the distance. So does the size of the
voxels of a grid in contracted space: scene contraction (Barron et al. 2022).
"""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

NEAREST_TO_RIM = 1e-6
"""Fraction of the radius that contracted points keep from the sphere that stands for infinity."""


@dataclass(frozen=True, slots=True)
class Contraction:
    """Map between points x of the world and contracted ones y, the same within a ball.

    Beyond its radius R, of distances from its centre, |y| = R (2 - R / |x|): all of the world lies
    within 2 R. A step along the ray from the centre is (|x| / R)^2 times as long in the world, one
    across it less.
    """

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the ball, world frame."""
    radius: float = math.inf
    """Radius of the ball, map units; if infinite, nothing is contracted."""

    def __bool__(self) -> bool:
        """Whether anything is contracted."""
        return math.isfinite(self.radius)

    def contracted(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Contracted positions of world points."""
        if not self:
            return points
        away, distance = self._away(points)
        outer = self.radius / distance.clamp(min=self.radius)
        return points + away * (outer * (2 - outer) - 1)

    def expanded(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """World positions of contracted points; those at infinity or beyond are very far.

        Computed in float64, returned in the points' type.
        """
        if not self:
            return points
        away, distance = self._away(points.double())
        held = (distance / self.radius).clamp(1, 2 - NEAREST_TO_RIM)
        return (points + away * (1 / (held * (2 - held)) - 1)).to(points)

    def growth(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Ratio, at world points, of a radial step in the world to that in contracted space."""
        return (self._away(points)[1] / self.radius)[..., 0].clamp(min=1).square()

    def balls(
        self, points: Float[Tensor, "*n 3"], radius: float
    ) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n"] | float]:
        """Centres and radii of balls of the world that contain balls of contracted space."""
        if not self:
            return points, radius
        middle = self.expanded(points)
        outermost = (self._away(points)[1][..., 0] + radius) / self.radius
        return middle, radius / (2 - outermost.clamp(1, 2 - NEAREST_TO_RIM)).square()

    def _away(self, points: Float[Tensor, "*n 3"]) -> tuple[Tensor, Float[Tensor, "*n 1"]]:
        away = points - points.new_tensor(self.centre)
        return away, away.norm(dim=-1, keepdim=True)


UNCONTRACTED = Contraction()
"""No contraction."""
