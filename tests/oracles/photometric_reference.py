"""Photometric dissimilarity of two images, per pixel: robust L_1, SSIM and NCC.

All functions take images in [0, 1] of any floating type, grey ``(h, w)`` or with channels last
``(h, w, c)``, and a mask of comparable pixels; channels are averaged. They return the loss of every
pixel and the mask of the pixels where it counts; outside it the loss is 0. The mask is constant,
gradients flow to the images.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.losses.kernel_settings import NCC_VARIANCE_FLOOR


def _channels_first(image: Tensor) -> Tensor:
    """``(c, 1, h, w)``: every channel an image of its own for convolutions."""
    flat = image if image.ndim == 3 else image[..., None]
    return flat.permute(2, 0, 1)[:, None]


def _window_mean(image: Tensor, side: int) -> Tensor:
    """Mean over the square window around each pixel; windows that leave the image give 0."""
    return F.pad(F.avg_pool2d(image, side, stride=1), [side // 2] * 4)


def robust_l1(
    reference: Float[Tensor, "h w *c"],
    warped: Float[Tensor, "h w *c"],
    mask: Bool[Tensor, "h w"],
    huber: float = 0.0,
    cut: float = float("inf"),
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Absolute difference, quadratic below ``huber`` and constant above ``cut`` (both grey values).

    The slope between them is 1, so ``huber=0`` and an infinite ``cut`` give the printed loss: paper
    Eq. l1, per pixel, mean over channels. The quadratic part is Huber's; without it the sign of
    tiny differences shakes converged pixels.
    """
    difference = (warped - reference).abs()
    difference = torch.where(difference < cut, difference, difference.detach().clamp(max=cut))
    if huber > 0:
        quadratic = difference.square() / (2 * huber)
        difference = torch.where(difference < huber, quadratic, difference - huber / 2)
    loss = difference.flatten(2).mean(-1) if difference.ndim == 3 else difference
    return torch.where(mask, loss, torch.zeros_like(loss)), mask


def ncc(
    reference: Float[Tensor, "h w *c"],
    warped: Float[Tensor, "h w *c"],
    mask: Bool[Tensor, "h w"],
    patch: int = 7,
    reject: float = 0.9,
    min_variance: float = 1e-4,
    min_coverage: float = 0.7,
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``1 - NCC`` over square windows, signed.

    Paper Eq. zncc. Masked pixels of ``warped`` are filled from ``reference``, so that they add no
    difference, and windows with less than ``min_coverage`` of comparable pixels are left out, as
    are windows that leave the image, whose reference has a variance below ``min_variance`` (of
    grey values), or with ``1 - NCC >= reject`` (PGSR's rejection of occluded patches).
    """
    a = _channels_first(reference)
    b = torch.where(mask, _channels_first(warped), a)
    mean_a, mean_b = _window_mean(a, patch), _window_mean(b, patch)
    variance_a = (_window_mean(a * a, patch) - mean_a.square()).clamp(min=0)
    variance_b = (_window_mean(b * b, patch) - mean_b.square()).clamp(min=0)
    covariance = _window_mean(a * b, patch) - mean_a * mean_b
    deviations = (variance_a + NCC_VARIANCE_FLOOR) * (variance_b + NCC_VARIANCE_FLOOR)
    loss = 1 - covariance * deviations.rsqrt()

    coverage = _window_mean(mask.to(a.dtype)[None, None], patch)
    used = (coverage >= min_coverage) & (variance_a > min_variance) & (loss < reject)
    loss = torch.where(used, loss, torch.zeros_like(loss))
    return loss.mean((0, 1)), used.any(0)[0]


def ssim(
    reference: Float[Tensor, "h w *c"],
    warped: Float[Tensor, "h w *c"],
    mask: Bool[Tensor, "h w"],
    min_coverage: float = 0.7,
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``1 - SSIM`` with Gaussian windows (11x11, sigma 1.5) normalised over the masked pixels.

    Paper Eq. ssim; Wang et al. 2004 with C1 = 0.01^2, C2 = 0.03^2. A pixel counts where it is in
    the mask and its window holds at least ``min_coverage`` of comparable weight; what lies outside
    the image or the mask is not seen by the window.
    """
    m = mask.to(reference.dtype)[None, None]
    a, b = _channels_first(reference) * m, torch.where(mask, _channels_first(warped), 0.0)
    offset = torch.arange(-5, 6, dtype=a.dtype, device=a.device)
    line = (-(offset**2) / (2 * 1.5**2)).exp()
    line = line / line.sum()

    def blur(x: Tensor) -> Tensor:
        return F.conv2d(F.conv2d(x, line[None, None, :, None], padding=(5, 0)),
                        line[None, None, None], padding=(0, 5))  # fmt: skip

    coverage = blur(m)
    covered = coverage.clamp(min=1e-6)
    mean_a, mean_b = blur(a) / covered, blur(b) / covered
    variance_a = blur(a * a) / covered - mean_a.square()
    variance_b = blur(b * b) / covered - mean_b.square()
    covariance = blur(a * b) / covered - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    structure = (2 * covariance + c2) / (variance_a + variance_b + c2)
    used = mask & (coverage[0, 0] >= min_coverage)
    loss = (1 - luminance * structure).mean((0, 1))
    return torch.where(used, loss, torch.zeros_like(loss)), used
