"""Our recurrent flow network for static scenes and dense bundle adjustment.

It starts from the flow predicted by poses and depths, looks up the cells' descriptors around their
estimated positions, and iterates (after RAFT and DROID-SLAM). Every iteration estimates the error
of its flow: each axis has a mixture of two Laplace distributions (after SEA-RAFT), one for matched
cells and one for unmatched cells.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from geogs.networks.tensor_files import load_trained
from geogs.tracking.flow.lookup import (
    CHANNELS,
    WINDOW,
    DescriptorPyramid,
    Edges,
    PyramidLevel,
    correlation_windows,
)
from geogs.tracking.flow.network_parts import cell_pixels, two_convolutions
from geogs.tracking.flow.own_options import NetworkOptions
from geogs.world.grid import STRIDE

FLOW_UNIT = 16.0
"""Pixels per unit of flow in the network."""


@dataclass(frozen=True)
class FlowFeatures:
    """Features of images; cells are those of the sample grid."""

    source: Float[Tensor, "n p c"]
    """Descriptors of the cells."""
    pyramid: DescriptorPyramid
    hidden: Float[Tensor, "n ch gh gw"]
    """Initial state of the iterations."""
    context: Float[Tensor, "n cx gh gw"]


@dataclass(frozen=True)
class LaplaceMixture:
    """Error of a flow along each axis: of a matched or an unmatched cell."""

    logit: Float[Tensor, "e p 1"]
    """Logit of the probability that a cell is matched."""
    log_scale: Float[Tensor, "e p 2"]
    """Logarithm of the Laplace scale in pixels of a matched cell."""
    log_outlier: Float[Tensor, "e p 2"]
    """The same for an unmatched cell; larger."""

    def variance(self) -> Float[Tensor, "e p 2"]:
        """Return the variance of the mixture, pixels^2 (2 b^2 for a Laplace scale b)."""
        p = self.logit.sigmoid()
        return 2 * (p * (2 * self.log_scale).exp() + (1 - p) * (2 * self.log_outlier).exp())

    def weight(self, floor: float) -> Float[Tensor, "e p 2"]:
        """Return the weight of a flow in an adjustment, 1 / pixel^2: the probability of a match
        over its variance; ``floor`` is a deviation in pixels."""
        return self.logit.sigmoid() / (2 * (2 * self.log_scale).exp() + floor**2)

    def negative_log_likelihood(self, error: Float[Tensor, "e p 2"]) -> Float[Tensor, "e p"]:
        """Return the negative log-likelihood of errors in pixels, mean over both axes."""
        parts = []
        for logit, log_scale in ((self.logit, self.log_scale), (-self.logit, self.log_outlier)):
            density = -error.abs() * (-log_scale).exp() - log_scale - 0.693147
            parts.append(functional.logsigmoid(logit) + density)
        return -torch.logaddexp(*parts).mean(-1)


@dataclass(frozen=True)
class FlowEstimate:
    """Flow after one iteration."""

    pixels: Float[Tensor, "e p 2"]
    """Positions of the cells in the second image."""
    error: LaplaceMixture
    state: Float[Tensor, "e ch gh gw"]


class FlowNetwork(nn.Module):
    """The network: encoder, recurrent update, heads and convex upsampling."""

    def __init__(self, options: NetworkOptions | None = None) -> None:
        super().__init__()
        self.options = options or NetworkOptions()
        self.encoder = FlowEncoder(self.options)
        self.update = FlowUpdate(self.options)
        self.upsampling = two_convolutions(self.options.hidden, 80, 9 * STRIDE * STRIDE, 3, 1)

    def encode(self, images: Float[Tensor, "n 3 h w"]) -> FlowFeatures:
        """Compute features of RGB images in [0, 1], on the cells of :class:`SampleGrid`."""
        return self.encoder(images)

    def iterate(
        self, features: FlowFeatures, edges: Edges, start: Float[Tensor, "e p 2"], iterations: int
    ) -> Iterator[FlowEstimate]:
        """Yield estimates of the positions of each edge's first cells in its second image, pixels.

        ``start``: initial positions. Positions are detached between iterations.
        """
        first = edges.first.long()
        state = features.hidden[first]
        context = features.context[first]
        height, width = state.shape[-2:]
        cells = cell_pixels(height, width, start)
        pixels = start
        confidence = torch.zeros_like(start)
        for _ in range(iterations):
            pixels = pixels.detach()
            windows = correlation_windows(features.source, features.pyramid, edges, pixels)
            flow = torch.cat([pixels - cells, pixels - start, FLOW_UNIT * confidence], -1)
            state, raw = self.update(
                state, context, _image(windows, height), _image(flow / FLOW_UNIT, height)
            )
            values = raw.float().flatten(2).mT
            pixels = pixels + values[..., :2]
            error = _mixture(values)
            confidence = (error.log_scale / 4).detach()
            yield FlowEstimate(pixels, error, state)

    def upsample(self, estimate: FlowEstimate, height: int, width: int) -> Float[Tensor, "e h w 2"]:
        """Upsample flow to pixels by convex combinations of the nine cells around each."""
        state = estimate.state
        gh, gw = state.shape[-2:]
        flow = estimate.pixels - cell_pixels(gh, gw, estimate.pixels)
        flow = functional.pad(_image(flow, gh), (1, 1, 1, 1), mode="replicate")
        near = functional.unfold(flow, 3).reshape(len(flow), 2, 9, 1, 1, gh, gw)
        logits = 0.25 * self.upsampling(state).float()
        weight = logits.reshape(len(flow), 1, 9, STRIDE, STRIDE, gh, gw).softmax(2)
        full = (weight * near).sum(2).permute(0, 4, 2, 5, 3, 1)
        full = full.reshape(len(flow), gh * STRIDE, gw * STRIDE, 2)
        beyond = (0, max(0, width - full.shape[2]), 0, max(0, height - full.shape[1]))
        if any(beyond):
            full = functional.pad(full.permute(0, 3, 1, 2), beyond, mode="replicate")
            full = full.permute(0, 2, 3, 1)
        return full[:, :height, :width]


def load_flow_network(path: Path) -> FlowNetwork:
    """Load the network from a weights file; raises InputError if it is missing or another's."""
    return load_trained(path, "flow", lambda about: FlowNetwork(NetworkOptions(**about["options"])))


class FlowEncoder(nn.Module):
    """One trunk for descriptors and context, so that an image is encoded once.

    Pixel of a position i: 2 i at 1/2, 4 i at 1/4, 4 + 8 i at 1/8, where the cells are.
    """

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        o = options
        self.levels = o.levels
        self.stem = nn.Sequential(
            nn.Conv2d(3, o.stem, 7, stride=2, padding=3), _norm(o.stem), nn.ReLU()
        )
        self.at_half = FlowResidual(o.stem, o.stem)
        self.at_quarter = nn.Sequential(
            FlowResidual(o.stem, o.middle, 1), FlowResidual(o.middle, o.middle)
        )
        self.at_eighth = nn.Sequential(
            FlowResidual(o.middle, o.deep, 0),
            FlowResidual(o.deep, o.deep),
            FlowResidual(o.deep, o.deep),
        )
        self.describe_cells = nn.Conv2d(o.deep, CHANNELS, 1)
        self.deep_to_quarter = nn.ConvTranspose2d(o.deep, o.middle, 3, stride=2)
        self.describe_quarter = nn.Sequential(
            nn.ReLU(), *two_convolutions(o.middle, o.middle, CHANNELS, 3, 1)
        )
        if 2 in o.levels:
            self.quarter_to_half = nn.ConvTranspose2d(
                o.middle, o.stem, 3, stride=2, padding=1, output_padding=1
            )
            self.describe_half = nn.Sequential(
                nn.ReLU(), *two_convolutions(o.stem, o.stem, CHANNELS, 3, 1)
            )
        self.state = two_convolutions(o.deep, 128, o.hidden + o.context, 3, 1)
        self.hidden = o.hidden

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> FlowFeatures:
        height, width = images.shape[-2:]
        gh, gw = -(-(height - 7) // STRIDE), -(-(width - 7) // STRIDE)
        beyond = (0, -width % STRIDE, 0, -height % STRIDE)
        images = functional.pad(images, beyond, mode="replicate")
        half = self.at_half(self.stem(4 * images - 2))
        quarter = self.at_quarter(half)
        eighth = self.at_eighth(quarter)
        joined = quarter + self.deep_to_quarter(eighth)[..., :-1, :-1]
        fields = {4: _descriptors(self.describe_quarter(joined))}
        if 2 in self.levels:
            fields[2] = _descriptors(self.describe_half(half + self.quarter_to_half(joined)))
        for step in range(3, 8):
            fields[2**step] = functional.avg_pool2d(fields[2 ** (step - 1)], 2, ceil_mode=True)
        state = self.state(eighth)[..., :gh, :gw]
        hidden, context = state.split([self.hidden, state.shape[1] - self.hidden], 1)
        return FlowFeatures(
            _descriptors(self.describe_cells(eighth)[..., :gh, :gw]).flatten(2).mT.contiguous(),
            _pyramid({stride: fields[stride] for stride in self.levels}),
            hidden.tanh(),
            context.relu(),
        )


class FlowResidual(nn.Module):
    """Two convolutions with a shortcut; ``shift`` halves the resolution.

    Output i of a halving block is at input 2 i + 1 - shift.
    """

    def __init__(self, inputs: int, outputs: int, shift: int | None = None) -> None:
        super().__init__()
        self.shift = shift
        stride = 1 if shift is None else 2
        self.first = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1 if stride == 1 else 0)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.norm_first = _norm(outputs)
        self.norm_second = _norm(outputs)
        self.shortcut = nn.Conv2d(inputs, outputs, 1) if stride == 2 else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        beside = x
        if self.shift is not None:
            beside = x[..., 1 - self.shift :: 2, 1 - self.shift :: 2]
            x = functional.pad(x, (self.shift, 1 - self.shift, self.shift, 1 - self.shift))
        y = self.norm_first(self.first(x)).relu()
        return (self.norm_second(self.second(y)) + self.shortcut(beside)).relu()


class FlowUpdate(nn.Module):
    """One iteration: windows and flow in, a convolutional GRU, step and uncertainty out."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        o = options
        self.windows = two_convolutions(len(o.levels) * WINDOW, 128, o.motion, 1, 3, nn.ReLU())
        self.flow = two_convolutions(6, 48, 32, 5, 3, nn.ReLU())
        inputs = o.hidden + o.context + o.motion + 32
        self.gates = nn.Conv2d(inputs, 2 * o.hidden, 3, padding=1)
        self.candidate = nn.Conv2d(inputs, o.hidden, 3, padding=1)
        self.view = nn.Conv2d(o.hidden, o.hidden, 1)
        self.view_to_gates = nn.Linear(o.hidden, 3 * o.hidden)
        self.head = two_convolutions(o.hidden, 112, 7, 3, 1)

    def forward(
        self, state: Tensor, context: Tensor, windows: Tensor, flow: Tensor
    ) -> tuple[Tensor, Tensor]:
        x = torch.cat([context, self.windows(windows), self.flow(flow)], 1)
        # Global context, as in DROID-SLAM: a weighted mean of the state.
        mean = (self.view(state).sigmoid() * state).mean((2, 3))
        gate_bias, candidate_bias = self.view_to_gates(mean)[..., None, None].split(
            [2 * state.shape[1], state.shape[1]], 1
        )
        gates = (self.gates(torch.cat([state, x], 1)) + gate_bias).sigmoid()
        keep, reset = gates.chunk(2, 1)
        candidate = self.candidate(torch.cat([reset * state, x], 1)) + candidate_bias
        state = (1 - keep) * state + keep * candidate.tanh()
        return state, self.head(state)


def _mixture(values: Float[Tensor, "e p k"]) -> LaplaceMixture:
    scale = values[..., 2:4].clamp(-4.5, 3.0)
    outlier = scale + 1.0 + functional.softplus(values[..., 4:6])
    return LaplaceMixture(values[..., 6:7] + 2.0, scale, outlier.clamp(max=5.0))


def _descriptors(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """Normalise descriptors: a perfect match correlates by sqrt(c), a random one by 0."""
    return CHANNELS**0.5 * functional.normalize(x.float(), dim=1)


def _pyramid(fields: dict[int, Tensor]) -> DescriptorPyramid:
    """Build the levels, by stride in pixels; those above 4 are repeated means of 2 x 2."""
    levels = []
    for stride, field in fields.items():
        # A mean of k x k descriptors at 4 i is centred (k - 1) / 2 of them further on.
        shift = 0.0 if stride <= 4 else (4 / stride - 1) / 2
        levels.append(PyramidLevel(field.shape[-1], field.shape[-2], 1 / stride, shift))
    flat = torch.cat([field.flatten(2).mT for field in fields.values()], 1)
    return DescriptorPyramid(flat, tuple(levels))


def _image(values: Float[Tensor, "e p k"], height: int) -> Float[Tensor, "e k h w"]:
    """Reshape values of cells to an image; the channels stay innermost in memory."""
    return values.unflatten(1, (height, -1)).permute(0, 3, 1, 2)


def _norm(channels: int) -> nn.Module:
    """Return a norm independent of the batch, and of gain and offset of the exposure."""
    return nn.InstanceNorm2d(channels, affine=True)
