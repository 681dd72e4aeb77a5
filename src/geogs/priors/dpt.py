"""The dense prediction transformer DPT-Hybrid (Ranftl 2021), name by name as it was published."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from geogs.priors.vit_hybrid import PATCH, WIDTH, HybridTransformer

FEATURES = 256
STAGES = (0, 1)
"""Stages of the stem that the decoder looks at."""
BLOCKS = (8, 11)
"""Blocks of the transformer that it looks at."""
MULTIPLE = 32
"""Height and width of the image must be multiples of this."""


def _doubling() -> nn.Module:
    return nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True)


class TokenReadout(nn.Module):
    """Mixes the class token into every other one."""

    def __init__(self) -> None:
        super().__init__()
        self.project = nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.GELU())

    def forward(self, tokens: Float[Tensor, "b n d"]) -> Float[Tensor, "b m d"]:
        rest = tokens[:, 1:]
        return self.project(torch.cat([rest, tokens[:, :1].expand_as(rest)], -1))


def _reassemble(halved: bool) -> nn.ModuleDict:
    """Tokens to a map; the names are places in the published sequence, the others hold nothing."""
    parts = {"0": TokenReadout(), "3": nn.Conv2d(WIDTH, WIDTH, 1)}
    if halved:
        parts["4"] = nn.Conv2d(WIDTH, WIDTH, 3, stride=2, padding=1)
    return nn.ModuleDict(parts)


class Encoder(nn.Module):
    """The backbone, and four maps of its inside at 1/4, 1/8, 1/16 and 1/32 of the size."""

    def __init__(self) -> None:
        super().__init__()
        self.model = HybridTransformer()
        self.act_postprocess3 = _reassemble(halved=False)
        self.act_postprocess4 = _reassemble(halved=True)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> list[Tensor]:
        shape = (x.shape[2] // PATCH, x.shape[3] // PATCH)
        maps, tokens = self.model(x, STAGES, BLOCKS)
        for parts, t in zip((self.act_postprocess3, self.act_postprocess4), tokens, strict=True):
            m = parts["3"](parts["0"](t).transpose(1, 2).unflatten(2, shape))
            maps.append(parts["4"](m) if "4" in parts else m)
        return maps


class ResidualUnit(nn.Module):
    """Two activated convolutions added to what came in."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(FEATURES, FEATURES, 3, padding=1)
        self.conv2 = nn.Conv2d(FEATURES, FEATURES, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    """Adds a map to the coarser result, refines, doubles the size."""

    def __init__(self) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(FEATURES, FEATURES, 1)
        self.resConfUnit1 = ResidualUnit()  # published, but unused, in the coarsest one, too
        self.resConfUnit2 = ResidualUnit()
        self.upsample = _doubling()

    def forward(
        self, x: Float[Tensor, "b c h w"], finer: Float[Tensor, "b c h w"] | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        if finer is not None:
            x = x + self.resConfUnit1(finer)
        return self.out_conv(self.upsample(self.resConfUnit2(x)))


class Decoder(nn.Module):
    """From the encoder's maps to the result."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        for n, width in enumerate((256, 512, WIDTH, WIDTH), 1):
            setattr(self, f"layer{n}_rn", nn.Conv2d(width, FEATURES, 3, padding=1, bias=False))
            setattr(self, f"refinenet{n}", Fusion())
        self.output_conv = nn.Sequential(
            nn.Conv2d(FEATURES, FEATURES // 2, 3, padding=1),
            _doubling(),
            nn.Conv2d(FEATURES // 2, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, channels, 1),
            nn.ReLU(),
        )

    def forward(self, maps: list[Tensor]) -> Float[Tensor, "b c h w"]:
        path = None
        for n in (4, 3, 2, 1):
            finer = self.get_submodule(f"layer{n}_rn")(maps[n - 1])
            fusion = self.get_submodule(f"refinenet{n}")
            path = fusion(finer) if path is None else fusion(path, finer)
        return self.output_conv(path)


class DptHybrid(nn.Module):
    """An image to ``channels`` maps that are not negative, of the image's size."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.pretrained = Encoder()
        self.scratch = Decoder(channels)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h w"]:
        """Height and width must be multiples of ``MULTIPLE``."""
        return self.scratch(self.pretrained(x))
