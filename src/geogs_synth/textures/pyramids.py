"""The renderer's bank of textures: square images with all their smaller levels."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class TextureBank:
    """t square textures whose sides are a power of two, each followed by its halved levels."""

    texels: Int[Tensor, "t texels"]
    """32 bits each: red, green, blue from the lowest byte up."""
    size: int
    """Side of the finest level."""
    materials: int
    """Number of materials (wood, plaster, noise), which come first; the others are images."""

    @property
    def levels(self) -> int:
        """Number of levels, with the last of one texel."""
        return self.size.bit_length()

    @staticmethod
    def pack(images: UInt8[Tensor, "t s s 3"], materials: int) -> "TextureBank":
        """A bank of these images, with area averages for the smaller levels."""
        level = images.movedim(-1, 1).float()
        pieces = []
        while True:
            pieces.append(level.round().flatten(2))
            if level.shape[-1] == 1:
                break
            level = torch.nn.functional.avg_pool2d(level, 2)
        red, green, blue = torch.cat(pieces, -1).to(torch.int32).unbind(1)
        return TextureBank((red | green << 8 | blue << 16).contiguous(), images.shape[1], materials)

    def sample(
        self, texture: Int[Tensor, "*n"], position: Float[Tensor, "*n 2"], level: Int[Tensor, "*n"]
    ) -> Float[Tensor, "*n 3"]:
        """Bilinear colour in 0..1; positions in repeats of the texture, level 0 is the finest."""
        side = (self.size >> level)[..., None]
        # Texels of the levels before this one: a geometric series.
        start = (4 * self.size**2 - 4 * (self.size >> level) ** 2) // 3
        corner = (position - position.floor()) * side - 0.5
        low = corner.floor()
        weight = corner - low
        x0, y0 = (low.long() % side).unbind(-1)
        x1, y1 = ((low.long() + 1) % side).unbind(-1)
        wx, wy = weight[..., :1], weight[..., 1:]

        def texel(x: Tensor, y: Tensor) -> Tensor:
            packed = self.texels[texture, start + y * side[..., 0] + x]
            channels = [(packed >> shift) & 255 for shift in (0, 8, 16)]
            return torch.stack(channels, -1).to(position.dtype) / 255

        top = (1 - wx) * texel(x0, y0) + wx * texel(x1, y0)
        bottom = (1 - wx) * texel(x0, y1) + wx * texel(x1, y1)
        return (1 - wy) * top + wy * bottom
