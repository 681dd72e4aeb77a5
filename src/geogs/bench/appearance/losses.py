"""The losses of 2DGS: L1, SSIM and the consistency of normals."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_SIDE, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(one: Float[Tensor, "h w c"], other: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al. 2004) of two images in [0, 1].

    Gaussian windows of 11 pixels, sigma 1.5; only windows that lie wholly in the image count.
    """
    a, b = one.permute(2, 0, 1), other.permute(2, 0, 1)
    channels = len(a)
    blurred = _blur(torch.cat([a, b, a * a, b * b, a * b])).unflatten(0, (5, channels))
    mean_a, mean_b, square_a, square_b, product = blurred
    mean_ab = mean_a * mean_b
    mean_squares = mean_a * mean_a + mean_b * mean_b
    luminance = (2 * mean_ab + _C1) / (mean_squares + _C1)
    structure = (2 * (product - mean_ab) + _C2) / (square_a + square_b - mean_squares + _C2)
    return (luminance * structure).mean()


def photometric_loss(
    rendered: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], ssim_weight: float
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), Kerbl et al. 2023, Eq. 7."""
    l1 = (rendered - target).abs().mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(rendered, target))


def normal_loss(
    normal: Float[Tensor, "h w 3"],
    depth_normal: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """Mean of 1 - n . N alpha: blended disk normals against those of the depth map.

    Huang et al. 2024, Eq. 14, with the weights' sum taken into the blended normal; the opacity
    is constant.
    """
    cosine = (normal * depth_normal).sum(-1) * alpha.detach()
    return (1 - cosine).mean()


def _blur(images: Float[Tensor, "n h w"]) -> Float[Tensor, "n h2 w2"]:
    """Gaussian mean of each window inside the image."""
    offset = torch.arange(_SIDE, dtype=images.dtype, device=images.device) - _SIDE // 2
    kernel = torch.exp(-0.5 * (offset / _SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    rows = F.conv2d(images[:, None], kernel.view(1, 1, -1, 1))
    return F.conv2d(rows, kernel.view(1, 1, 1, -1))[:, 0]
