"""Depth of a keyframe's cells from monocular priors and depth sensors."""

from dataclasses import dataclass
from typing import Annotated

from jaxtyping import Float32
from torch import Tensor

from geogs.config.setting import Range
from geogs.limits import AT_LEAST_0
from geogs.priors.monocular_prior import DepthKind


@dataclass
class KeyframePrior:
    """Monocular depth prior of a keyframe and its scale; mutable."""

    kind: DepthKind
    values: Float32[Tensor, "p"]
    """Output of the prior, on the grid."""
    inverse_depth: Annotated[Float32[Tensor, "p"], AT_LEAST_0]
    """Aligned to the tracker's; 0 where unknown, and everywhere before the first alignment."""
    scale: Float32[Tensor, "k"]
    """Factors of the aligned inverse depth at the nodes of a coarse grid, row by row."""
    information: Annotated[Float32[Tensor, "p"], Range(0)]
    """Contribution to the inverse variance of the keyframe's inverse depth."""
    is_aligned: bool = False

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.scale = self.scale / factor
        self.information = self.information * factor**2


@dataclass
class MeasuredCells:
    """Sensor depth of a keyframe's cells, in map units; mutable."""

    inverse_depth: Annotated[Float32[Tensor, "p"], AT_LEAST_0]
    information: Annotated[Float32[Tensor, "p"], Range(0)]
    """Inverse variance of inverse depth; 0 where it was not measured."""

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.inverse_depth = self.inverse_depth / factor
        self.information = self.information * factor**2
