"""Scores of flow: error, fraction of outliers, calibration of the predicted uncertainty."""

from dataclasses import asdict, dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from geogs.tracking.flow.cell_texture import MIN_STRUCTURE

LARGE_MOTION = 16.0
"""Least large motion, pixels."""
OUTLIER = 1.0
"""Largest error of an inlier, pixels."""


@dataclass(frozen=True)
class FlowScores:
    """Errors over visible pixels, in pixels unless stated."""

    dense: float
    """Mean end-point error of every pixel."""
    epe: float
    """Mean end-point error of the cells."""
    median: float
    """Median over the cells."""
    textureless: float
    """Mean over cells without texture."""
    large: float
    """Mean over cells that move by more than 16 pixels."""
    outliers: float
    """Fraction of cells with errors above a pixel."""
    within: float
    """Fraction of cells with errors in x and y within two predicted standard deviations."""
    within_visible_large: float
    """The same over cells that move by more than 16 pixels."""
    sure_share: float
    """Fraction of cells with a predicted standard deviation below half a pixel."""
    sure_error: float
    """Mean error of those."""

    def line(self) -> str:
        """Format on one line."""
        return "  ".join(f"{name} {value:.3f}" for name, value in asdict(self).items())


@dataclass(frozen=True)
class CellErrors:
    """Errors of flow on cells, one row a cell."""

    error: Float[Tensor, "n 2"]
    """Pixels."""
    deviation: Float[Tensor, "n 2"]
    """Predicted standard deviation, pixels."""
    motion: Float[Tensor, "n"]
    """Length of the true flow, pixels."""
    textured: Bool[Tensor, "n"]
    dense: Float[Tensor, "m"]
    """End-point errors of all pixels."""


def summarise(parts: list[CellErrors]) -> FlowScores:
    """Scores over all cells of several batches."""
    rows = zip(*(vars(part).values() for part in parts), strict=True)
    error, deviation, motion, textured, dense = map(torch.cat, rows)
    length = error.norm(dim=-1)
    inside = (error.abs() < 2 * deviation).float().mean(-1)
    large = motion > LARGE_MOTION
    sure = deviation.amax(-1) < 0.5
    return FlowScores(
        dense=float(dense.mean()),
        epe=float(length.mean()),
        median=float(length.median()),
        textureless=_mean(length, ~textured),
        large=_mean(length, large),
        outliers=float((length > OUTLIER).float().mean()),
        within=float(inside.mean()),
        within_visible_large=_mean(inside, large),
        sure_share=float(sure.float().mean()),
        sure_error=_mean(length, sure),
    )


def has_texture(images: Float[Tensor, "n 3 h w"]) -> Bool[Tensor, "n h w"]:
    """Mask where the structure tensor over 9 x 9 pixels has no small eigenvalue, as in tracking."""
    weights = images.new_tensor([0.299, 0.587, 0.114]) * 255
    grey = (images * weights[:, None, None]).sum(1, keepdim=True)
    kernel = images.new_tensor([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 8
    padded = functional.pad(grey, (1, 1, 1, 1), mode="replicate")
    gx, gy = (functional.conv2d(padded, k[None, None]) for k in (kernel, kernel.mT))
    xx, yy, xy = (functional.avg_pool2d(p, 9, 1, 4)[:, 0] for p in (gx * gx, gy * gy, gx * gy))
    smaller = (xx + yy) / 2 - (((xx - yy) / 2) ** 2 + xy * xy).sqrt()
    return smaller > MIN_STRUCTURE


def _mean(values: Tensor, chosen: Bool[Tensor, "n"]) -> float:
    return float(values[chosen].mean()) if bool(chosen.any()) else float("nan")
