"""Calibration of the standard deviations and confidences of the depth network."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.depth.network.depth_calibration import TOLERANCE, DepthCalibration, right_logit
from geogs_train.depth.depth_scores import DepthErrors

BELIEVED = 0.5
"""Probability of an outlier below which a pixel's standard deviation is calibrated."""
_STEPS = 50


def calibrated(pixels: DepthErrors) -> DepthCalibration:
    """Fit the calibration to pixels of rooms that the network was not trained on.

    Scales are multiplied so that as many errors lie within two standard deviations as of a Laplace
    distribution; the probability to be right is fitted by logistic regression.
    """
    scale = pixels.deviation / 2**0.5
    ratio = (pixels.error.abs() / scale)[pixels.outlier < BELIEVED]
    two = 2 * 2**0.5
    fraction = 1 - torch.tensor(-two).exp()
    factor = float(_quantile(ratio, float(fraction))) / two if len(ratio) else 1.0
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
    for _ in range(_STEPS):
        p = (X @ w).sigmoid()
        slope = X.T @ (p - right.to(X)) + ridge @ (w - start)
        curvature = (X * (p * (1 - p))[:, None]).T @ X + ridge
        step = torch.linalg.solve(curvature, slope)
        w = w - step.clamp(-1, 1)
    return float(w[0]), float(w[1])


def _quantile(values: Float[Tensor, "n"], fraction: float) -> Float[Tensor, ""]:
    """A quantile of values, without ``torch.quantile``'s limit on their number."""
    ordered = values.sort().values
    return ordered[min(int(fraction * len(values)), len(values) - 1)]
