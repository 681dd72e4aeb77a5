"""Correlation of two feature maps around given positions, as in DROID-SLAM (after RAFT).

All-pairs products of the features, averaged over 2 x 2, 4 x 4, ... pixels of the second map, are
read in a square window around a position (Teed & Deng, "RAFT: Recurrent All-Pairs Field Transforms
for Optical Flow", ECCV 2020, section 3.2).

Conventions, which are those of the published networks:

- positions are in pixels of the feature maps, x before y, pixel centres at integers;
- on level l of the pyramid they are divided by 2^l only (the network has to learn the half-pixel
  shift of the centres of averaged pixels);
- beyond the border the correlation is zero;
- the channels are ordered by level, then x offset, then y offset: channel
  ``(l (2 r + 1) + i) (2 r + 1) + j`` is at (x + i - r, y + j - r).
"""

import torch
from jaxtyping import Float
from torch import Tensor


class CorrelationVolume:
    """All-pairs correlation, computed once and read many times: 16 h^2 w^2 / 3 bytes a pair."""

    def __init__(
        self,
        first: Float[Tensor, "b d h w"],
        second: Float[Tensor, "b d h w"],
        levels: int,
        radius: int,
        scale: float,
    ) -> None:
        """Multiply all pairs of features.

        Args:
            first: features of the pixels that are looked up.
            second: features of the images they are looked for in.
            levels: levels of the pyramid.
            radius: window radius, pixels of a level.
            scale: factor on the products.
        """
        self.radius = radius
        root = scale**0.5
        # Half of the factor on each side: products of half-precision features stay in range.
        a, b = (first * root).flatten(2), (second * root).flatten(2)
        volume = (a.mT @ b).reshape(-1, 1, *second.shape[-2:])
        self._levels = _pyramid(volume, levels)

    def __call__(self, coords: Float[Tensor, "b h w 2"]) -> Float[Tensor, "b c h w"]:
        windows = [
            _window(level.flatten(1), level.shape[-2:], coords / 2**k, self.radius)
            for k, level in enumerate(self._levels)
        ]
        return torch.cat(windows, 1)


def _pyramid(image: Float[Tensor, "n c h w"], levels: int) -> list[Tensor]:
    """Return means over 2^l x 2^l pixels; a level without pixels has size zero."""
    found = [image]
    for _ in range(levels - 1):
        height, width = found[-1].shape[-2:]
        if min(height, width) < 2:
            found.append(image.new_zeros(*image.shape[:2], height // 2, width // 2))
        else:
            found.append(torch.nn.functional.avg_pool2d(found[-1], 2))
    return found


def _window(
    products: Float[Tensor, "n q"],
    size: torch.Size,
    coords: Float[Tensor, "b h w 2"],
    radius: int,
) -> Float[Tensor, "b c h w"]:
    """Read a bilinear window of each row of products, an image of this size; zero outside.

    All positions of a window have the same fraction, so the values at (2 r + 2)^2 whole pixels are
    enough.
    """
    height, width = size
    side = 2 * radius + 1
    if not height or not width:
        return coords.new_zeros(len(coords), side * side, *coords.shape[1:3], dtype=torch.float32)
    # Far away (or NaN) is equivalent to just outside.
    limit = coords.new_tensor([width, height]) + radius + 1
    near = coords.float().nan_to_num(-1e6).clamp(min=-radius - 2.0).minimum(limit.float())
    corner = near.floor()
    fx, fy = ((near - corner)[..., None, None, k] for k in (0, 1))
    steps = torch.arange(-radius, radius + 2, device=coords.device)
    x, y = (corner[..., None, k].long() + steps for k in (0, 1))
    inside = ((x >= 0) & (x < width))[..., :, None] & ((y >= 0) & (y < height))[..., None, :]
    index = y.clamp(0, height - 1)[..., None, :] * width + x.clamp(0, width - 1)[..., :, None]
    values = products.gather(1, index.reshape(len(products), -1)).reshape(index.shape)
    values = torch.where(inside, values.float(), 0.0)
    values = values[..., :-1, :] * (1 - fx) + values[..., 1:, :] * fx
    values = values[..., :-1] * (1 - fy) + values[..., 1:] * fy
    return values.flatten(3).permute(0, 3, 1, 2)
