"""RAFT's network, large and small.

Teed & Deng, "RAFT: Recurrent All-Pairs Field Transforms for Optical Flow", ECCV 2020. Parameters
carry the names of the original repository (without its ``module.``), so that its checkpoints load;
:mod:`geogs.tracking.flow.raft_layout` maps those of torchvision.

Feature cell (r, c) is centred at pixel (8 c, 8 r); flow inside the network is in cells.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from geogs.tracking.flow.correlation import CorrelationLookup

CELL = 8
"""Pixels of the image between two feature cells."""


@dataclass(frozen=True)
class RaftShape:
    """What tells the two published sizes of the network apart."""

    features: int
    """Channels of the features that are correlated."""
    hidden: int
    """Channels of the recurrent state."""
    context: int
    """Channels of the context that enters each update."""
    widths: tuple[int, int, int]
    """Channels of an encoder at 1/2, 1/4 and 1/8 of the resolution."""
    is_small: bool
    """Bottleneck blocks, a plain GRU and bilinear upsampling."""
    radius: int
    """Of the window in which correlation is looked up, cells."""
    motion: int
    """Channels of the motion features, the flow itself included."""
    flow_head: int
    """Channels inside the head that gives the flow's change."""
    levels: int = 4
    """Of the correlation pyramid."""

    @property
    def window(self) -> int:
        """Channels of a correlation window over all levels."""
        return self.levels * (2 * self.radius + 1) ** 2


LARGE = RaftShape(256, 128, 128, (64, 96, 128), False, radius=4, motion=128, flow_head=256)
SMALL = RaftShape(128, 96, 64, (32, 64, 96), True, radius=3, motion=82, flow_head=128)


@dataclass(frozen=True)
class RaftFeatures:
    """What the network keeps of an image."""

    features: Float[Tensor, "b d h w"]
    """Of each cell, to be correlated."""
    hidden: Float[Tensor, "b s h w"]
    """Start of the recurrent state where this image is the first of a pair."""
    context: Float[Tensor, "b k h w"]
    """What every update sees of the first image."""


@dataclass(frozen=True)
class RaftEstimate:
    """Result of the network."""

    cells: Float[Tensor, "b 2 h w"]
    """Flow x, y of each cell, in cells."""
    pixels: Float[Tensor, "b 2 h8 w8"]
    """Flow x, y of each pixel, in pixels."""


class RaftNetwork(nn.Module):
    """Features of an image, and recurrent updates of the flow between two."""

    def __init__(self, shape: RaftShape = LARGE) -> None:
        super().__init__()
        self.shape = shape
        norm = nn.Identity if shape.is_small else nn.BatchNorm2d
        self.fnet = Encoder(shape, nn.InstanceNorm2d, shape.features)
        self.cnet = Encoder(shape, norm, shape.hidden + shape.context)
        self.update_block = UpdateBlock(shape)

    def encode(self, image: Float[Tensor, "b 3 h8 w8"]) -> RaftFeatures:
        """Features and context of RGB images in [-1, 1], both sides multiples of 8."""
        hidden, context = self.cnet(image).split([self.shape.hidden, self.shape.context], 1)
        return RaftFeatures(self.fnet(image), hidden.tanh(), context.relu())

    def estimate(
        self,
        first: RaftFeatures,
        correlation: CorrelationLookup,
        start: Float[Tensor, "b 2 h w"] | None,
        iterations: int,
    ) -> RaftEstimate:
        """Flow of the first images after so many updates of ``start``, in cells (None is zero)."""
        hidden = first.hidden
        batch, _, height, width = hidden.shape
        rest = cell_grid(height, width, hidden.device).expand(batch, -1, -1, -1)
        flow = torch.zeros_like(rest) if start is None else start
        for _ in range(iterations):
            # As the published training, which does not differentiate the position of the window.
            flow = flow.detach()
            window = correlation((rest + flow).permute(0, 2, 3, 1))
            hidden, change = self.update_block(hidden, first.context, window, flow)
            flow = flow + change.float()
        if self.shape.is_small:
            return RaftEstimate(flow, upsample_bilinear(flow))
        logits = 0.25 * self.update_block.mask(hidden)
        return RaftEstimate(flow, upsample_convex(flow, logits.float()))


class Encoder(nn.Module):
    """Residual network to an eighth of the resolution."""

    def __init__(self, shape: RaftShape, norm: type[nn.Module], channels: int) -> None:
        super().__init__()
        block = BottleneckBlock if shape.is_small else ResidualBlock
        w1, w2, w3 = shape.widths
        self.conv1 = nn.Conv2d(3, w1, 7, stride=2, padding=3)
        self.norm1 = norm(w1)
        self.layer1 = nn.Sequential(block(w1, w1, norm, 1), block(w1, w1, norm, 1))
        self.layer2 = nn.Sequential(block(w1, w2, norm, 2), block(w2, w2, norm, 1))
        self.layer3 = nn.Sequential(block(w2, w3, norm, 2), block(w3, w3, norm, 1))
        self.conv2 = nn.Conv2d(w3, channels, 1)

    def forward(self, image: Float[Tensor, "b 3 h8 w8"]) -> Float[Tensor, "b c h w"]:
        x = self.norm1(self.conv1(image)).relu()
        return self.conv2(self.layer3(self.layer2(self.layer1(x))))


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut, which is projected where the resolution halves."""

    def __init__(self, before: int, after: int, norm: type[nn.Module], stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride=stride, padding=1)
        self.conv2 = nn.Conv2d(after, after, 3, padding=1)
        self.norm1, self.norm2 = norm(after), norm(after)
        self.downsample = _shortcut(before, after, norm, stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        y = self.norm1(self.conv1(x)).relu()
        y = self.norm2(self.conv2(y)).relu()
        return (self.downsample(x) + y).relu()


class BottleneckBlock(nn.Module):
    """A 3 x 3 convolution of a quarter of the channels beside a shortcut."""

    def __init__(self, before: int, after: int, norm: type[nn.Module], stride: int) -> None:
        super().__init__()
        narrow = after // 4
        self.conv1 = nn.Conv2d(before, narrow, 1)
        self.conv2 = nn.Conv2d(narrow, narrow, 3, stride=stride, padding=1)
        self.conv3 = nn.Conv2d(narrow, after, 1)
        self.norm1, self.norm2, self.norm3 = norm(narrow), norm(narrow), norm(after)
        self.downsample = _shortcut(before, after, norm, stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        y = self.norm1(self.conv1(x)).relu()
        y = self.norm2(self.conv2(y)).relu()
        y = self.norm3(self.conv3(y)).relu()
        return (self.downsample(x) + y).relu()


def _shortcut(before: int, after: int, norm: type[nn.Module], stride: int) -> nn.Module:
    if stride == 1:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(before, after, 1, stride=stride), norm(after))


class UpdateBlock(nn.Module):
    """One recurrent update: motion features, state, change of the flow."""

    def __init__(self, shape: RaftShape) -> None:
        super().__init__()
        self.encoder = SmallMotionEncoder(shape) if shape.is_small else MotionEncoder(shape)
        gru = ConvGru if shape.is_small else SeparableGru
        self.gru = gru(shape.hidden, shape.context + shape.motion)
        self.flow_head = FlowHead(shape.hidden, shape.flow_head)
        if not shape.is_small:
            self.mask = nn.Sequential(
                nn.Conv2d(shape.hidden, 256, 3, padding=1),
                nn.ReLU(),
                nn.Conv2d(256, 9 * CELL**2, 1),
            )
            """Logits of the nine neighbours of each pixel; not needed before the last update."""

    def forward(
        self,
        hidden: Float[Tensor, "b s h w"],
        context: Float[Tensor, "b k h w"],
        window: Float[Tensor, "b c h w"],
        flow: Float[Tensor, "b 2 h w"],
    ) -> tuple[Float[Tensor, "b s h w"], Float[Tensor, "b 2 h w"]]:
        """The state after the update, and by how many cells the flow changes."""
        hidden = self.gru(hidden, torch.cat([context, self.encoder(flow, window)], 1))
        return hidden, self.flow_head(hidden)


class MotionEncoder(nn.Module):
    """Correlation and flow of a cell and its neighbours in one vector."""

    def __init__(self, shape: RaftShape) -> None:
        super().__init__()
        self.convc1 = nn.Conv2d(shape.window, 256, 1)
        self.convc2 = nn.Conv2d(256, 192, 3, padding=1)
        self.convf1 = nn.Conv2d(2, 128, 7, padding=3)
        self.convf2 = nn.Conv2d(128, 64, 3, padding=1)
        self.conv = nn.Conv2d(192 + 64, shape.motion - 2, 3, padding=1)

    def forward(
        self, flow: Float[Tensor, "b 2 h w"], window: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b m h w"]:
        seen = self.convc2(self.convc1(window).relu()).relu()
        moved = self.convf2(self.convf1(flow).relu()).relu()
        return torch.cat([self.conv(torch.cat([seen, moved], 1)).relu(), flow], 1)


class SmallMotionEncoder(nn.Module):
    """The same with fewer channels and one convolution less."""

    def __init__(self, shape: RaftShape) -> None:
        super().__init__()
        self.convc1 = nn.Conv2d(shape.window, 96, 1)
        self.convf1 = nn.Conv2d(2, 64, 7, padding=3)
        self.convf2 = nn.Conv2d(64, 32, 3, padding=1)
        self.conv = nn.Conv2d(96 + 32, shape.motion - 2, 3, padding=1)

    def forward(
        self, flow: Float[Tensor, "b 2 h w"], window: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b m h w"]:
        seen = self.convc1(window).relu()
        moved = self.convf2(self.convf1(flow).relu()).relu()
        return torch.cat([self.conv(torch.cat([seen, moved], 1)).relu(), flow], 1)


class ConvGru(nn.Module):
    """Gated recurrent unit with 3 x 3 convolutions."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        both = hidden + inputs
        self.convz = nn.Conv2d(both, hidden, 3, padding=1)
        self.convr = nn.Conv2d(both, hidden, 3, padding=1)
        self.convq = nn.Conv2d(both, hidden, 3, padding=1)

    def forward(
        self, h: Float[Tensor, "b s h w"], x: Float[Tensor, "b k h w"]
    ) -> Float[Tensor, "b s h w"]:
        return _gated(h, x, self.convz, self.convr, self.convq)


class SeparableGru(nn.Module):
    """Gated recurrent unit along rows, then another along columns."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        both = hidden + inputs
        self.convz1 = nn.Conv2d(both, hidden, (1, 5), padding=(0, 2))
        self.convr1 = nn.Conv2d(both, hidden, (1, 5), padding=(0, 2))
        self.convq1 = nn.Conv2d(both, hidden, (1, 5), padding=(0, 2))
        self.convz2 = nn.Conv2d(both, hidden, (5, 1), padding=(2, 0))
        self.convr2 = nn.Conv2d(both, hidden, (5, 1), padding=(2, 0))
        self.convq2 = nn.Conv2d(both, hidden, (5, 1), padding=(2, 0))

    def forward(
        self, h: Float[Tensor, "b s h w"], x: Float[Tensor, "b k h w"]
    ) -> Float[Tensor, "b s h w"]:
        h = _gated(h, x, self.convz1, self.convr1, self.convq1)
        return _gated(h, x, self.convz2, self.convr2, self.convq2)


def _gated(h: Tensor, x: Tensor, update: nn.Module, reset: nn.Module, new: nn.Module) -> Tensor:
    both = torch.cat([h, x], 1)
    z, r = update(both).sigmoid(), reset(both).sigmoid()
    return (1 - z) * h + z * new(torch.cat([r * h, x], 1)).tanh()


class FlowHead(nn.Module):
    """Change of the flow from the state."""

    def __init__(self, hidden: int, inside: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(hidden, inside, 3, padding=1)
        self.conv2 = nn.Conv2d(inside, 2, 3, padding=1)

    def forward(self, hidden: Float[Tensor, "b s h w"]) -> Float[Tensor, "b 2 h w"]:
        return self.conv2(self.conv1(hidden).relu())


def cell_grid(height: int, width: int, device: torch.device) -> Float[Tensor, "1 2 h w"]:
    """x, y of each cell, in cells."""
    y, x = torch.meshgrid(
        torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
    )
    return torch.stack([x, y])[None].float()


def upsample_convex(
    flow: Float[Tensor, "b 2 h w"], logits: Float[Tensor, "b m h w"]
) -> Float[Tensor, "b 2 h8 w8"]:
    """Flow in pixels: of each pixel a convex combination of the 3 x 3 cells around its own.

    ``logits`` are ordered by neighbour (row by row), then row and column of the pixel in its cell.
    """
    batch, _, height, width = flow.shape
    weight = logits.reshape(batch, 1, 9, CELL, CELL, height, width).softmax(2)
    near = nn.functional.unfold(CELL * flow, 3, padding=1).reshape(batch, 2, 9, 1, 1, height, width)
    blocks = (weight * near).sum(2)
    return blocks.permute(0, 1, 4, 2, 5, 3).reshape(batch, 2, CELL * height, CELL * width)


def upsample_bilinear(flow: Float[Tensor, "b 2 h w"]) -> Float[Tensor, "b 2 h8 w8"]:
    """Flow in pixels between the cells, the corner cells at the corner pixels."""
    size = [CELL * n for n in flow.shape[-2:]]
    return CELL * nn.functional.interpolate(flow, size=size, mode="bilinear", align_corners=True)
