"""L_ssim and its gradient on a CPU, by separable filters."""

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.config import LossConfig
from geogs.losses.kernel_settings import MIN_COVERAGE

# Constants of Wang et al. 2004.
_C1, _C2, _SIGMA, _REACH = 0.01**2, 0.03**2, 1.5, 5
_LINE = np.exp(-(np.arange(-_REACH, _REACH + 1) ** 2) / (2 * _SIGMA**2))
_LINE = (_LINE / _LINE.sum()).astype(np.float64)


def _blurred(image: np.ndarray) -> np.ndarray:
    """Gaussian window sums with zeros beyond the border; the filter is its own adjoint."""
    return cv2.sepFilter2D(image, -1, _LINE, _LINE, borderType=cv2.BORDER_CONSTANT)


def ssim_gradient(
    reference: Float32[np.ndarray, "h w"],
    warped: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"],
    config: LossConfig,
) -> tuple[float, Float32[np.ndarray, "h w"]]:
    """Weighted L_ssim over all pixels and its gradient in the warped image, computed in float64.

    Windows are normalised over the mask, and a pixel of it counts where its window is covered
    enough: paper Eq. ssim.
    """
    m = (mask > 0).astype(np.float64)
    a, b = reference * m, warped * m
    coverage = _blurred(m)
    covered = np.maximum(coverage, 1e-6)
    mean_a, mean_b = _blurred(a) / covered, _blurred(b) / covered
    variance_a = _blurred(a * a) / covered - mean_a**2
    variance_b = _blurred(b * b) / covered - mean_b**2
    covariance = _blurred(a * b) / covered - mean_a * mean_b
    above, below = 2 * mean_a * mean_b + _C1, mean_a**2 + mean_b**2 + _C1
    upper, lower = 2 * covariance + _C2, variance_a + variance_b + _C2
    luminance, structure = above / below, upper / lower
    used = m * (coverage >= np.float64(np.float32(MIN_COVERAGE)))
    weight = config.ssim_weight / mask.size
    loss = weight * float((used * (1 - luminance * structure)).sum())

    # Derivatives by the three window sums that contain the warped image.
    out = -weight * used / covered
    d_luminance = 2 * (mean_a - luminance * mean_b) / below
    d_variance, d_covariance = -structure / lower, 2 / lower
    in_mean = out * (
        structure * d_luminance - luminance * (2 * mean_b * d_variance + mean_a * d_covariance)
    )
    in_square, in_product = out * luminance * d_variance, out * luminance * d_covariance
    gradient = _blurred(in_mean) + 2 * b * _blurred(in_square) + a * _blurred(in_product)
    return loss, (gradient * m).astype(np.float32)
