"""The maps of a monocular prior, and the meaning of their numbers."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor


class DepthKind(Enum):
    """Relation of a network's numbers x to the depth z along the optical axis."""

    METRIC = "metric"
    """z = x metres, as far as the network is right about the camera; the tracker's unit is not
    metres, so it is used as a scale-free depth."""
    SCALE_FREE = "scale_free"
    """z = a x with one unknown a > 0 per image."""
    AFFINE_DEPTH = "affine_depth"
    """z = a x + b with unknown a > 0 and b per image."""
    AFFINE_INVERSE = "affine_inverse"
    """1 / z = a x + b with unknown a > 0 and b per image: inverse depth or disparity."""

    @property
    def has_shift(self) -> bool:
        """Whether depth is known only up to a shift besides the scale."""
        return self in (DepthKind.AFFINE_DEPTH, DepthKind.AFFINE_INVERSE)


@dataclass(frozen=True, eq=False)
class PriorMaps:
    """Maps of a prior for one image, at its size; either may be missing."""

    kind: DepthKind = DepthKind.SCALE_FREE
    """Meaning of the numbers of ``depth``."""
    depth: Float[Tensor, "h w"] | None = None
    """Depth or inverse depth, by ``kind``; NaN where unknown, as is a depth that is not positive
    if the kind has no shift."""
    normal: Float[Tensor, "h w 3"] | None = None
    """Unit normals in the camera frame (x right, y down, z forward) that face the camera, so that
    a wall seen straight on has (0, 0, -1); zero where unknown."""


@runtime_checkable
class MonocularPrior(Protocol):
    """Predicts depth or normals from single images."""

    def predict(self, image: UInt8[np.ndarray, "h w 3"]) -> PriorMaps:
        """Maps of an RGB image, at its size; tensors may be on any device."""
        ...


@dataclass(frozen=True, eq=False)
class CombinedPrior:
    """Depth from one prior, normals from another."""

    depth: MonocularPrior
    normal: MonocularPrior

    def predict(self, image: UInt8[np.ndarray, "h w 3"]) -> PriorMaps:
        """The depth of the first with the normals of the second."""
        maps = self.depth.predict(image)
        return PriorMaps(maps.kind, maps.depth, self.normal.predict(image).normal)
