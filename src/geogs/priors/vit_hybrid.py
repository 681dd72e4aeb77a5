"""The backbone of DPT-Hybrid: a ResNet-50 stem of three stages under a ViT-B/16.

Layer by layer and name by name timm's ``vit_base_r50_s16_384``, whose weights the published
checkpoints hold: group norm, weight-standardised convolutions with TensorFlow's SAME padding, a
transformer of twelve blocks on patches of 16 pixels. Sources: ViT (Dosovitskiy 2021), BiT
(Kolesnikov 2020) for the stem.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

WIDTH = 768
DEPTH = 12
HEADS = 12
PATCH = 16
"""Pixels of the image per token."""
TRAINED = 24
"""Tokens along one side of the images it was trained on (384 pixels)."""
CLASSES = 1000
_STAGES = ((3, 256, 1), (4, 512, 2), (9, 1024, 2))
"""Blocks, channels and stride of the stem's stages."""
_CONV_EPSILON = 1e-8
_NORM_EPSILON = 1e-6
_GROUPS = 32


def pad_same(x: Float[Tensor, "b c h w"], kernel: int, stride: int, value: float) -> Tensor:
    """Padding after which the size is divided by the stride, rounded up; the odd pixel at the end.

    TensorFlow's SAME.
    """
    h, w = (max((math.ceil(n / stride) - 1) * stride + kernel - n, 0) for n in x.shape[-2:])
    return F.pad(x, (w // 2, w - w // 2, h // 2, h - h // 2), value=value)


class StandardisedConv(nn.Conv2d):
    """Convolution whose filters are brought to mean 0 and variance 1 (Qiao 2019)."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int = 1) -> None:
        super().__init__(channels, out, kernel, stride, bias=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o h2 w2"]:
        mean = self.weight.mean((1, 2, 3), keepdim=True)
        variance = self.weight.var((1, 2, 3), unbiased=False, keepdim=True)
        weight = (self.weight - mean) * (variance + _CONV_EPSILON).rsqrt()
        x = pad_same(x, self.kernel_size[0], self.stride[0], 0.0)
        return F.conv2d(x, weight, stride=self.stride)


class Shortcut(nn.Module):
    """What a bottleneck adds its result to where size or channels change."""

    def __init__(self, channels: int, out: int, stride: int) -> None:
        super().__init__()
        self.conv = StandardisedConv(channels, out, 1, stride)
        self.norm = nn.GroupNorm(_GROUPS, out)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o h2 w2"]:
        return self.norm(self.conv(x))


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3, 1 x 1, activated after the sum."""

    def __init__(self, channels: int, out: int, stride: int) -> None:
        super().__init__()
        middle = out // 4
        is_same = channels == out and stride == 1
        self.downsample = None if is_same else Shortcut(channels, out, stride)
        self.conv1 = StandardisedConv(channels, middle, 1)
        self.norm1 = nn.GroupNorm(_GROUPS, middle)
        self.conv2 = StandardisedConv(middle, middle, 3, stride)
        self.norm2 = nn.GroupNorm(_GROUPS, middle)
        self.conv3 = StandardisedConv(middle, out, 1)
        self.norm3 = nn.GroupNorm(_GROUPS, out)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o h2 w2"]:
        inner = F.relu(self.norm1(self.conv1(x)))
        inner = F.relu(self.norm2(self.conv2(inner)))
        inner = self.norm3(self.conv3(inner))
        return F.relu(inner + (x if self.downsample is None else self.downsample(x)))


class Stem(nn.Module):
    """First convolution and pooling, to a quarter of the size."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = StandardisedConv(3, 64, 7, 2)
        self.norm = nn.GroupNorm(_GROUPS, 64)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 64 h2 w2"]:
        x = F.relu(self.norm(self.conv(x)))
        return F.max_pool2d(pad_same(x, 3, 2, -torch.inf), 3, 2)


class Stage(nn.Module):
    """Some bottlenecks, of which the first changes size and channels."""

    def __init__(self, blocks: int, channels: int, out: int, stride: int) -> None:
        super().__init__()
        first = Bottleneck(channels, out, stride)
        self.blocks = nn.Sequential(first, *(Bottleneck(out, out, 1) for _ in range(blocks - 1)))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o h2 w2"]:
        return self.blocks(x)


class ConvolutionalStem(nn.Module):
    """The three stages; gives the result of each."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = Stem()
        channels, stages = 64, []
        for blocks, out, stride in _STAGES:
            stages.append(Stage(blocks, channels, out, stride))
            channels = out
        self.stages = nn.ModuleList(stages)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> list[Tensor]:
        x = self.stem(x)
        results = []
        for stage in self.stages:
            x = stage(x)
            results.append(x)
        return results


class PatchEmbedding(nn.Module):
    """The stem and the step from its channels to tokens."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = ConvolutionalStem()
        self.proj = nn.Conv2d(_STAGES[-1][1], WIDTH, 1)


class Attention(nn.Module):
    """Self-attention of several heads."""

    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.proj = nn.Linear(WIDTH, WIDTH)

    def forward(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        b, n, _ = x.shape
        q, k, v = self.qkv(x).reshape(b, n, 3, HEADS, -1).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v)
        return self.proj(mixed.transpose(1, 2).reshape(b, n, -1))


class FeedForward(nn.Module):
    """Two layers, four times as wide in between."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1 = nn.Linear(WIDTH, 4 * WIDTH)
        self.fc2 = nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        return self.fc2(F.gelu(self.fc1(x)))


class TransformerBlock(nn.Module):
    """Attention and feed-forward, each normalised before and added to what came in."""

    def __init__(self) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(WIDTH, eps=_NORM_EPSILON)
        self.attn = Attention()
        self.norm2 = nn.LayerNorm(WIDTH, eps=_NORM_EPSILON)
        self.mlp = FeedForward()

    def forward(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class HybridTransformer(nn.Module):
    """The backbone; gives what DPT looks at."""

    def __init__(self) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, WIDTH))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + TRAINED**2, WIDTH))
        self.patch_embed = PatchEmbedding()
        self.blocks = nn.ModuleList([TransformerBlock() for _ in range(DEPTH)])
        # Of the classifier, which the checkpoints hold as well.
        self.norm = nn.LayerNorm(WIDTH, eps=_NORM_EPSILON)
        self.head = nn.Linear(WIDTH, CLASSES)

    def forward(
        self, x: Float[Tensor, "b 3 h w"], stages: tuple[int, ...], blocks: tuple[int, ...]
    ) -> tuple[list[Tensor], list[Float[Tensor, "b n d"]]]:
        """Maps of those stages of the stem, and tokens (the class first) after those blocks.

        Height and width must be multiples of the patch.
        """
        rows, columns = x.shape[2] // PATCH, x.shape[3] // PATCH
        maps = self.patch_embed.backbone(x)
        tokens = self.patch_embed.proj(maps[-1]).flatten(2).transpose(1, 2)
        tokens = torch.cat([self.cls_token.expand(len(x), -1, -1), tokens], 1)
        tokens = tokens + self._places(rows, columns)
        found = []
        for n, block in enumerate(self.blocks[: max(blocks) + 1]):
            tokens = block(tokens)
            if n in blocks:
                found.append(tokens)
        return [maps[k] for k in stages], found

    def _places(self, rows: int, columns: int) -> Float[Tensor, "1 n d"]:
        """Positional embedding for another number of tokens, by bilinear interpolation."""
        grid = self.pos_embed[:, 1:].reshape(1, TRAINED, TRAINED, WIDTH).permute(0, 3, 1, 2)
        grid = F.interpolate(grid, (rows, columns), mode="bilinear", align_corners=False)
        return torch.cat([self.pos_embed[:, :1], grid.flatten(2).transpose(1, 2)], 1)
