"""The maps of a monocular prior, the meaning of their numbers, and their alignment."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.robust import weighted_median

MIN_CELLS = 32
"""Cells that must be known to both for an alignment."""
FARTHEST = 0.05
"""Aligned inverse depth below this fraction of its median counts as unknown (sky, a bad shift)."""
_BINS = 12
"""Bins of the cells, by their value, between whose medians lines are tried."""
_CUT = 2.0
"""Deviations at which a cell has a quarter of its weight (Geman and McClure's weight)."""


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


def align_inverse_depth(
    values: Float[Tensor, "p"],
    kind: DepthKind,
    inverse_depth: Float[Tensor, "p"],
    weight: Float[Tensor, "p"],
) -> Float[Tensor, "p"] | None:
    """The prior as inverse depth in the tracker's unit, fitted by a scale (and a shift, if its kind
    has one); 0 where unknown.

    A scale alone is the weighted median ratio. Scale and shift minimise the weighted relative
    error by reweighted least squares (Geman and McClure), begun at the best line through the
    medians of two parts of the cells, so that wrong cells do not matter while they are fewer.
    ``inverse_depth`` is the tracker's, ``weight`` the weight of each cell (0: not known).
    None if too few cells are known, or if the prior confuses near and far.
    """
    finite = torch.isfinite(values)
    known = finite & (weight > 0) & (inverse_depth > 0)
    if not kind.has_shift:
        finite = finite & (values > 0)
        known = known & finite
    if int(known.sum()) < MIN_CELLS:
        return None
    x, d, w = (v[known].double() for v in (values, inverse_depth, weight))
    if not kind.has_shift:
        inverse = 1 / values.double()
        scale = weighted_median(d * x, w)
        aligned = torch.where(finite, scale * inverse, 0.0)
    else:
        # Both are fits of y = a x + b whose error is relative to y.
        y = d if kind is DepthKind.AFFINE_INVERSE else 1 / d
        fitted = _robust_line(x, y, w)
        if fitted is None:
            return None
        line = fitted[0] * values.double() + fitted[1]
        if kind is DepthKind.AFFINE_DEPTH:
            line = torch.where(line > 0, 1 / line, 0.0)
        aligned = torch.where(finite, line, 0.0)
    aligned = _without_far(aligned)
    if int((known & (aligned > 0)).sum()) < MIN_CELLS:
        return None
    return aligned.to(inverse_depth)


def _robust_line(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], w: Float[Tensor, "n"]
) -> tuple[float, float] | None:
    """Slope and offset of y = a x + b with the error relative to y; None if a is not positive."""
    line = _best_of_medians(x, y, w)
    if line is None:
        return None
    rows = torch.stack([x, torch.ones_like(x)], -1) / y[:, None]

    def linearised(line: Float[Tensor, "2"]) -> tuple[Tensor, Tensor]:
        error = rows @ line - 1
        width = _CUT * 1.4826 * weighted_median(error.abs(), w) + 1e-6
        v = w / (1 + (error / width).square()).square()
        weighted = rows * v[:, None]
        return rows.mT @ weighted, weighted.sum(0)

    def solved(
        line: Float[Tensor, "2"], linear: tuple[Tensor, Tensor], damping: float
    ) -> Step[Tensor]:
        normal, right = linear
        return Step(torch.linalg.solve(normal + torch.diag(damping * normal.diagonal()), right))

    line = minimise(line, linearised, solved, Policy(8, damping=1e-9)).state
    a, b = line.tolist()
    return (a, b) if a > 0 and bool(torch.isfinite(line).all()) else None


def _best_of_medians(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], w: Float[Tensor, "n"]
) -> Float[Tensor, "2"] | None:
    """The rising line through the medians of two parts that has the least median error."""
    parts = torch.argsort(x).tensor_split(_BINS)
    u, v = (torch.stack([weighted_median(q[p], w[p]) for p in parts]) for q in (x, y))
    i, j = torch.triu_indices(_BINS, _BINS, 1, device=x.device)
    slope = (v[j] - v[i]) / (u[j] - u[i]).clamp(min=1e-12)
    rising = (slope > 0) & (u[j] - u[i] > 1e-6 * x.abs().max())
    if not bool(rising.any()):
        return None
    lines = torch.stack([slope, v[i] - slope * u[i]], -1)[rising]
    errors = (x * lines[:, :1] + lines[:, 1:]).div(y).sub(1).abs()
    medians = torch.stack([weighted_median(e, w) for e in errors])
    return lines[int(medians.argmin())]


def _without_far(inverse_depth: Float[Tensor, "p"]) -> Float[Tensor, "p"]:
    """Inverse depth, 0 where it is not positive or below ``FARTHEST`` times its median."""
    positive: Bool[Tensor, "p"] = inverse_depth > 0
    if not bool(positive.any()):
        return torch.zeros_like(inverse_depth)
    least = FARTHEST * inverse_depth[positive].median()
    return torch.where(inverse_depth > least, inverse_depth, 0.0)
