"""The artefacts of lossy image compression: coefficients of 8 x 8 blocks are rounded."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_SIDE = 8
_TO_YCC = ((0.299, 0.587, 0.114), (-0.1687, -0.3313, 0.5), (0.5, -0.4187, -0.0813))
_TO_RGB = ((1.0, 0.0, 1.402), (1.0, -0.3441, -0.7141), (1.0, 1.772, 0.0))


def compress(
    images: Float[Tensor, "n 3 h w"], step: Float[Tensor, "n"]
) -> Float[Tensor, "n 3 h w"]:
    """Images in 0..1 as they look after compression with a quantisation step.

    ``step`` is that of the lowest brightness frequency, in 8-bit levels: 2 is hardly seen, 30 is
    coarse. Steps grow with frequency, and are larger for colour, roughly as in JPEG's tables.
    """
    n, _, h, w = images.shape
    padded = torch.nn.functional.pad(images, (0, -w % _SIDE, 0, -h % _SIDE), mode="replicate")
    rows, columns = padded.shape[2] // _SIDE, padded.shape[3] // _SIDE
    to_ycc, to_rgb = (torch.tensor(m, device=images.device) for m in (_TO_YCC, _TO_RGB))
    ycc = torch.einsum("ij,njhw->nihw", to_ycc, padded) * 255
    blocks = ycc.reshape(n, 3, rows, _SIDE, columns, _SIDE).transpose(3, 4)
    basis = _cosines(images.device)
    frequency = torch.arange(_SIDE, device=images.device)
    growth = 1 + 0.75 * (frequency[:, None] + frequency)
    channel = torch.tensor([1.0, 1.8, 1.8], device=images.device)
    table = step[:, None, None, None] * channel[:, None, None] * growth
    table = table[:, :, None, None]
    coefficients = (basis @ blocks @ basis.T / table).round() * table
    ycc = (basis.T @ coefficients @ basis).transpose(3, 4).reshape(padded.shape)
    return torch.einsum("ij,njhw->nihw", to_rgb, ycc / 255)[:, :, :h, :w]


def _cosines(device: torch.device) -> Float[Tensor, "8 8"]:
    """Orthonormal basis of the discrete cosine transform, a frequency per row."""
    k = torch.arange(_SIDE, device=device)
    basis = torch.cos(math.pi / _SIDE * (k + 0.5) * k[:, None]) * math.sqrt(2 / _SIDE)
    return torch.where(k[:, None] == 0, math.sqrt(1 / _SIDE), basis)
