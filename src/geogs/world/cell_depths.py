"""What monocular priors and depth sensors say of the depth of a keyframe's cells."""

from dataclasses import dataclass
from typing import Annotated

from jaxtyping import Float32
from torch import Tensor

from geogs.config.setting import Range
from geogs.limits import AT_LEAST_0
from geogs.priors.monocular_prior import DepthKind


@dataclass
class KeyframePrior:
    """What a monocular prior said of a keyframe's depth, and how it is scaled; mutable."""

    kind: DepthKind
    values: Float32[Tensor, "p"]
    """What the prior gave, on the grid."""
    inverse_depth: Annotated[Float32[Tensor, "p"], AT_LEAST_0]
    """Aligned to the tracker's; 0 where unknown, and everywhere before the first alignment."""
    scale: Float32[Tensor, "k"]
    """Factors of the aligned inverse depth at the nodes of a coarse grid, row by row."""
    information: Annotated[Float32[Tensor, "p"], Range(0)]
    """What it adds to the inverse variance of the keyframe's inverse depth."""
    is_aligned: bool = False

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.scale = self.scale / factor
        self.information = self.information * factor**2


@dataclass
class MeasuredCells:
    """What a depth sensor says of a keyframe's cells, in the lengths of the map; mutable."""

    inverse_depth: Annotated[Float32[Tensor, "p"], AT_LEAST_0]
    information: Annotated[Float32[Tensor, "p"], Range(0)]
    """Inverse variance of inverse depth; 0 where it says nothing."""

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.inverse_depth = self.inverse_depth / factor
        self.information = self.information * factor**2
