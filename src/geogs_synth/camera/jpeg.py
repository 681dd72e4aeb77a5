"""The artefacts of lossy image compression: coefficients of 8 x 8 blocks are rounded."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

Matrix = tuple[tuple[float, float, float], ...]

_SIDE = 8
_TO_YCC: Matrix = ((0.299, 0.587, 0.114), (-0.1687, -0.3313, 0.5), (0.5, -0.4187, -0.0813))
_TO_RGB: Matrix = ((1.0, 0.0, 1.402), (1.0, -0.3441, -0.7141), (1.0, 1.772, 0.0))


def compress(
    images: Float[Tensor, "n 3 h w"], step: Float[Tensor, "n"]
) -> Float[Tensor, "n 3 h w"]:
    """Images in 0..1 as they look after compression with a quantisation step.

    ``step`` is that of the lowest brightness frequency, in 8-bit levels: 2 is hardly seen, 30 is
    coarse. Steps grow with frequency, and are larger for colour, roughly as in JPEG's tables.
    """
    h, w = images.shape[-2:]
    padded = torch.nn.functional.pad(images, (0, -w % _SIDE, 0, -h % _SIDE), mode="replicate")
    rows, columns = padded.shape[2] // _SIDE, padded.shape[3] // _SIDE
    ycc = 255 * _mix(_TO_YCC, padded)
    basis = _cosines(images.device)
    frequency = torch.arange(_SIDE, device=images.device)
    growth = 1 + 0.75 * (frequency[:, None] + frequency).repeat(1, columns)
    colour = 1 + 0.8 * (torch.arange(3, device=images.device) > 0)
    table = step[:, None, None, None, None] * colour[:, None, None, None] * growth

    # Blocks stay in their rows of the image; a matrix for each of many tiny blocks would be slow.
    across = (ycc.unflatten(3, (columns, _SIDE)) @ basis.T).flatten(3)
    coefficients = basis @ across.unflatten(2, (rows, _SIDE))
    coefficients = (coefficients / table).round() * table
    down = (basis.T @ coefficients).flatten(2, 3)
    ycc = (down.unflatten(3, (columns, _SIDE)) @ basis).flatten(3)
    return _mix(_TO_RGB, ycc / 255)[:, :, :h, :w]


def _mix(matrix: Matrix, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Linear transform of colours; plain numbers need not be sent to the device."""
    a, b, c = image.unbind(1)
    return torch.stack([r[0] * a + r[1] * b + r[2] * c for r in matrix], 1)


def _cosines(device: torch.device) -> Float[Tensor, "8 8"]:
    """Orthonormal basis of the discrete cosine transform, a frequency per row."""
    k = torch.arange(_SIDE, device=device)
    basis = torch.cos(math.pi / _SIDE * (k + 0.5) * k[:, None]) * math.sqrt(2 / _SIDE)
    return torch.where(k[:, None] == 0, math.sqrt(1 / _SIDE), basis)
