"""Scores of depths and normals on textured, faint and bare surfaces, and of their calibration."""

from dataclasses import asdict, dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from geogs.depth.network.depth_calibration import TOLERANCE, DepthCalibration, right_logit

FAINT, TEXTURED = 0.4, 2.0
"""Gradients of the undisturbed picture in 8-bit levels per pixel, root mean square over 9 x 9
pixels: below the first a surface is bare, above the second textured, between them faint."""
KINDS = ("textured", "faint", "bare")
BELIEVED = 0.5
"""Probability of an outlier below which a depth is accepted."""


@dataclass(frozen=True)
class DepthErrors:
    """Errors of pixels, one row each."""

    error: Float[Tensor, "n"]
    """Logarithm of estimated over true depth."""
    deviation: Float[Tensor, "n"]
    """Predicted standard deviation of that."""
    outlier: Float[Tensor, "n"]
    """Predicted probability that the depth is an outlier."""
    angle: Float[Tensor, "n"]
    """Angle between estimated and true normals, degrees."""
    kind: UInt8[Tensor, "n"]
    """Index into ``KINDS``."""

    @staticmethod
    def join(parts: "list[DepthErrors]") -> "DepthErrors":
        """Join the pixels of several batches."""
        rows = zip(*(vars(part).values() for part in parts), strict=True)
        return DepthErrors(*map(torch.cat, rows))


@dataclass(frozen=True)
class DepthScores:
    """Scores over pixels of unseen rooms."""

    absolute: float
    """Mean relative error of depth."""
    median: float
    """Median relative error."""
    within_3: float
    """Fraction of pixels within a factor of 1.03."""
    within_5: float
    """Fraction within 1.05."""
    normal: float
    """Median error of normals, degrees."""
    within: float
    """Fraction of the accepted pixels (outlier below 1/2) with errors below two deviations."""
    believed: float
    """Fraction of pixels whose predicted probability to be an outlier is below 1/2."""
    sure: float
    """Fraction of pixels that are accepted and have a standard deviation below 3 %."""
    sure_absolute: float
    """Mean relative error of those."""
    textured_absolute: float
    textured_within_5: float
    textured_normal: float
    faint_absolute: float
    faint_within_5: float
    faint_normal: float
    bare_absolute: float
    bare_within_5: float
    bare_normal: float
    scale: float
    """Mean over the accepted pixels of absolute error over Laplace scale: 1 if calibrated."""

    def line(self) -> str:
        """Format on one line."""
        return "  ".join(f"{name} {value:.4f}" for name, value in asdict(self).items())


def summarise(pixels: DepthErrors) -> DepthScores:
    """Scores of all pixels."""
    relative = pixels.error.exp().sub(1).abs()
    believed = pixels.outlier < BELIEVED
    inside = pixels.error.abs() < 2 * pixels.deviation
    sure = believed & (pixels.deviation < 0.03)
    parts = {}
    for index, kind in enumerate(KINDS):
        of = pixels.kind == index
        parts[f"{kind}_absolute"] = _mean(relative[of])
        parts[f"{kind}_within_5"] = _within(pixels.error[of], 1.05)
        parts[f"{kind}_normal"] = _median(pixels.angle[of])
    ratio = pixels.error.abs() / (pixels.deviation / 2**0.5)
    return DepthScores(
        absolute=_mean(relative),
        median=_median(relative),
        within_3=_within(pixels.error, 1.03),
        within_5=_within(pixels.error, 1.05),
        normal=_median(pixels.angle),
        within=_mean(inside[believed].float()),
        believed=_mean(believed.float()),
        sure=_mean(sure.float()),
        sure_absolute=_mean(relative[sure]),
        scale=_mean(ratio[believed]),
        **parts,
    )


def texture_kind(light: Float[Tensor, "n 3 h w"]) -> UInt8[Tensor, "n h w"]:
    """Texture at every pixel, from linear light before the camera: 0 textured, 1 faint, 2 bare."""
    level = light.sqrt().mean((1, 2, 3), keepdim=True).square().clamp_min(1e-4)
    grey = (0.2 / level * light).clamp(1e-5, 1).pow(1 / 2.2).mean(1, keepdim=True) * 255
    padded = functional.pad(grey, (1, 1, 1, 1), mode="replicate")
    across = 0.5 * (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2])
    down = 0.5 * (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1])
    energy = across.square() + down.square()
    mean = functional.avg_pool2d(energy, 9, 1, 4, count_include_pad=False)[:, 0]
    return (mean < TEXTURED**2).to(torch.uint8) + (mean < FAINT**2).to(torch.uint8)


def _within(error: Tensor, factor: float) -> float:
    limit = torch.tensor(factor).log().item()
    return _mean((error.abs() < limit).float())


def _mean(values: Tensor) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _median(values: Tensor) -> float:
    return float(values.median()) if len(values) else float("nan")


def calibrated(pixels: DepthErrors) -> DepthCalibration:
    """Fit the calibration to pixels of rooms that the network was not trained on.

    Scales are multiplied so that as many errors lie within two standard deviations as of a Laplace
    distribution; the probability to be right is fitted by logistic regression.
    """
    scale = pixels.deviation / 2**0.5
    ratio = (pixels.error.abs() / scale)[pixels.outlier < BELIEVED]
    two = 2 * 2**0.5
    fraction = float(1 - torch.tensor(-two).exp())
    factor = 1.0
    if len(ratio):
        # The quantile; torch.quantile limits the number of values.
        rank = min(int(fraction * len(ratio)), len(ratio) - 1)
        factor = float(ratio.sort().values[rank]) / two
    right = pixels.error.abs() < TOLERANCE
    logit = right_logit(scale.log(), torch.logit(pixels.outlier, 1e-6))
    gain, offset = logistic_fit(logit.double(), right)
    return DepthCalibration(factor, gain, offset)


def logistic_fit(x: Float[Tensor, "n"], right: Bool[Tensor, "n"]) -> tuple[float, float]:
    """Maximum-likelihood gain and offset of the logit, by Newton's method.

    The likelihood is no sum of squares, so the least-squares loop cannot be used.
    """
    X = torch.stack([x, torch.ones_like(x)], 1)
    w = X.new_tensor([1.0, 0.0])
    ridge = 1e-3 * len(X) * torch.eye(2, dtype=X.dtype, device=X.device)
    start = w.clone()
    for _ in range(50):
        p = (X @ w).sigmoid()
        slope = X.T @ (p - right.to(X)) + ridge @ (w - start)
        curvature = (X * (p * (1 - p))[:, None]).T @ X + ridge
        step = torch.linalg.solve(curvature, slope)
        w = w - step.clamp(-1, 1)
    return float(w[0]), float(w[1])
