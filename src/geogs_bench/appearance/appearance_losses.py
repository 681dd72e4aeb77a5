"""The losses of 2DGS: L1, SSIM and the consistency of normals."""

import functools
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

_SIDE, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(one: Float[Tensor, "h w c"], other: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al. 2004) of two images in [0, 1].

    Gaussian windows of 11 pixels, sigma 1.5; only windows that lie wholly in the image count.
    Differentiable, once, in the first image alone.
    """
    return _StructuralSimilarity.apply(one, other)


def photometric_loss(
    rendered: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], ssim_weight: float
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), Kerbl et al. 2023, Eq. 7."""
    l1 = F.l1_loss(rendered, target)
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
    return 1 - cosine.mean()


class _StructuralSimilarity(torch.autograd.Function):
    """SSIM with its derivative written out: fewer operations, and all in full precision."""

    @staticmethod
    def forward(ctx: Any, one: Tensor, other: Tensor) -> Tensor:
        a, b = (image.permute(2, 0, 1).contiguous() for image in (one, other))
        mean_a, mean_b, square_a, square_b, product = _blur(
            torch.cat([a, b, a * a, b * b, a * b]), 0
        ).chunk(5)
        mean_ab = mean_a * mean_b
        mean_squares = mean_a.square().addcmul_(mean_b, mean_b)
        above_luminance = 2 * mean_ab + _C1
        above_structure = 2 * (product - mean_ab) + _C2
        below_luminance = mean_squares + _C1
        below_structure = square_a + square_b - mean_squares + _C2
        below = below_luminance * below_structure
        similarity = above_luminance * above_structure / below
        if ctx.needs_input_grad[0]:
            to_square = -similarity / below_structure
            to_product = 2 * above_luminance / below
            to_mean = 2 * mean_b * (above_structure - above_luminance) / below - 2 * mean_a * (
                similarity / below_luminance + to_square
            )
            ctx.save_for_backward(a, b, torch.cat([to_mean, to_square, to_product]))
        return similarity.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        a, b, derivatives = ctx.saved_tensors
        to_mean, to_square, to_product = _blur(derivatives, _SIDE - 1).chunk(3)
        total = (to_mean + 2 * a * to_square + b * to_product) * (
            gradient * (3 / derivatives.numel())
        )
        return total.permute(1, 2, 0), None


def _blur(images: Float[Tensor, "n h w"], padding: int) -> Float[Tensor, "n h2 w2"]:
    """Gaussian mean of each window; the images are padded with ``padding`` zeros.

    One convolution a channel, without cuDNN: its convolutions may round to the 10 bits of TF32,
    and then the variance, a difference of squares, is wrong by as much as the constants of SSIM.
    """
    n = len(images)
    kernel = _window(images.dtype, images.device).expand(n, 1, -1, 1)
    with torch.backends.cudnn.flags(enabled=False):
        rows = F.conv2d(images[None], kernel, padding=(padding, 0), groups=n)
        return F.conv2d(rows, kernel.transpose(2, 3), padding=(0, padding), groups=n)[0]


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "1 1 11 1"]:
    offset = torch.arange(_SIDE, dtype=dtype, device=device) - _SIDE // 2
    kernel = torch.exp(-0.5 * (offset / _SIGMA) ** 2)
    return (kernel / kernel.sum()).view(1, 1, -1, 1)
