"""Building blocks of the depth network."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


class Norm(nn.Module):
    """Group norm of eight channels each, in the precision of its input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.groups = max(1, channels // 8)
        while channels % self.groups:
            self.groups -= 1
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        b, c, h, w = x.shape
        weight = self.weight.to(x.dtype)
        bias = self.bias.to(x.dtype)
        # Autocast would convert every normalised image to float32.
        return torch.native_group_norm(
            x.contiguous(), weight, bias, b, c, h * w, self.groups, 1e-5
        )[0]


class Block(nn.Sequential):
    """Convolution, norm, ReLU; a kernel of even size halves the resolution, aligned to cells."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3) -> None:
        stride = 1 if kernel % 2 else 2
        padding = kernel // 2 - (stride - 1)
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False),
            Norm(outputs),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Residual block: two convolutions and a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = Block(channels, channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = Norm(channels)

    def forward(self, x: Tensor) -> Tensor:
        return (x + self.norm(self.second(self.first(x)))).relu_()


def doubled(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
    """Twice the resolution, bilinear, aligned to cells."""
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def upsampled(
    x: Float[Tensor, "b c h w"], logits: Float[Tensor, "b 36 h w"], gap: float
) -> Float[Tensor, "b c h2 w2"]:
    """Twice the resolution: each fine cell is a convex combination of the nine coarse ones around.

    ``logits`` are those of the nine cells, row by row, for each of the four fine cells of a cell.
    Cells whose first number differs by more than ``gap`` from that of the likeliest do not
    count, so nothing is averaged across an edge.
    """
    b, c, h, w = x.shape
    padded = functional.pad(x, (1, 1, 1, 1), mode="replicate")
    around = [padded[:, :, k // 3 : k // 3 + h, k % 3 : k % 3 + w] for k in range(9)]
    weight = logits.float().unflatten(1, (9, 4)).softmax(1)
    first = torch.stack([a[:, :1] for a in around], 1)
    likeliest = first.expand_as(weight).gather(1, weight.argmax(1, keepdim=True))
    weight = weight * ((first - likeliest).abs() <= gap)
    weight = weight / weight.sum(1, keepdim=True)
    total = x.new_zeros(b, c, 4, h, w)
    for k in range(9):
        total = total + around[k][:, :, None] * weight[:, k, None]
    return functional.pixel_shuffle(total.flatten(1, 2), 2)
