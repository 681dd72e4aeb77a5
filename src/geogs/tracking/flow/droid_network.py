"""The network of DROID-SLAM: encoders, recurrent update of an edge, aggregation over a frame.

Teed and Deng, "DROID-SLAM: Deep Visual SLAM for Monocular, Stereo, and RGB-D Cameras", NeurIPS
2021. Names of parameters and channels are those of the public weights, so that these load
unchanged. All positions are in cells of 1/8 of the image, x before y.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from geogs.errors import InputError
from geogs.guard.documents import in_short
from geogs.tracking.flow.lookup import VOLUME_LEVELS, WINDOW
from geogs.tracking.flow.network_parts import cell_positions, two_convolutions
from geogs.world.grid import OFFSET, STRIDE

TRIMMED = tuple(
    f"update.{head}.2.{kind}" for head in ("weight", "delta") for kind in ("weight", "bias")
)
"""Parameters with more outputs in the public weights than the first two, which are used."""


def on_cells(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h8 w8"]:
    """Crop images so that every eighth pixel is a cell of the sample grid.

    The first four rows and columns are removed; where the last cell has fewer than eight pixels,
    the border is replicated.
    """
    # The last cell has at least three pixels after its own.
    rows, columns = (n // STRIDE * STRIDE for n in images.shape[2:])
    part = images[:, :, OFFSET : OFFSET + rows, OFFSET : OFFSET + columns]
    beyond = (0, columns - part.shape[3], 0, rows - part.shape[2])
    return F.pad(part, beyond, mode="replicate")


def normalised(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Normalise RGB in [0, 1] by the mean and deviation of the encoders' training images."""
    mean = images.new_tensor([0.485, 0.456, 0.406])[:, None, None]
    deviation = images.new_tensor([0.229, 0.224, 0.225])[:, None, None]
    return (images - mean) / deviation


class DroidResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with a shortcut, which is a convolution where the size changes."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.norm = nn.InstanceNorm2d(outputs) if norm else nn.Identity()
        shortcut = nn.Conv2d(inputs, outputs, 1, stride)
        self.downsample = nn.Sequential(shortcut, self.norm) if stride > 1 else nn.Identity()

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h2 w2"]:
        y = F.relu(self.norm(self.conv1(x)))
        y = F.relu(self.norm(self.conv2(y)))
        return F.relu(self.downsample(x) + y)


class DroidEncoder(nn.Module):
    """Features of an image at an eighth of its resolution.

    Cell (r, c) of the output is centred on pixel (8 r, 8 c). The instance norm of the matching
    features has no parameters; the context has no norm.
    """

    def __init__(self, base: int, outputs: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, base, 7, 2, 3)
        self.norm = nn.InstanceNorm2d(base) if norm else nn.Identity()
        self.layer1 = self._layer(base, base, 1, norm)
        self.layer2 = self._layer(base, 2 * base, 2, norm)
        self.layer3 = self._layer(2 * base, 4 * base, 2, norm)
        self.conv2 = nn.Conv2d(4 * base, outputs, 1)

    @staticmethod
    def _layer(inputs: int, outputs: int, stride: int, norm: bool) -> nn.Sequential:
        first = DroidResidualBlock(inputs, outputs, stride, norm)
        return nn.Sequential(first, DroidResidualBlock(outputs, outputs, 1, norm))

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c h8 w8"]:
        x = F.relu(self.norm(self.conv1(images)))
        return self.conv2(self.layer3(self.layer2(self.layer1(x))))


class ConvGru(nn.Module):
    """A convolutional gated recurrent unit whose gates also get a mean over the whole image."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.convz = nn.Conv2d(hidden + inputs, hidden, 3, 1, 1)
        self.convr = nn.Conv2d(hidden + inputs, hidden, 3, 1, 1)
        self.convq = nn.Conv2d(hidden + inputs, hidden, 3, 1, 1)
        self.w = nn.Conv2d(hidden, hidden, 1)
        self.convz_glo = nn.Conv2d(hidden, hidden, 1)
        self.convr_glo = nn.Conv2d(hidden, hidden, 1)
        self.convq_glo = nn.Conv2d(hidden, hidden, 1)

    def forward(
        self, hidden: Float[Tensor, "e c h w"], inputs: Float[Tensor, "e c2 h w"]
    ) -> Float[Tensor, "e c h w"]:
        both = torch.cat([hidden, inputs], 1)
        whole = (self.w(hidden).sigmoid() * hidden).mean((2, 3), keepdim=True)
        z = (self.convz(both) + self.convz_glo(whole)).sigmoid()
        r = (self.convr(both) + self.convr_glo(whole)).sigmoid()
        proposed = self.convq(torch.cat([r * hidden, inputs], 1)) + self.convq_glo(whole)
        return (1 - z) * hidden + z * proposed.tanh()


class GraphAggregation(nn.Module):
    """Mean over the edges of a source frame, decoded to the damping of its depth.

    ``upmask``, the learned upsampling of depth, only exists for loading the public weights.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(hidden, hidden, 3, 1, 1)
        self.conv2 = nn.Conv2d(hidden, hidden, 3, 1, 1)
        self.eta = nn.Sequential(nn.Conv2d(hidden, 1, 3, 1, 1), nn.Softplus())
        self.upmask = nn.Sequential(nn.Conv2d(hidden, 9 * STRIDE**2, 1))

    def forward(
        self, hidden: Float[Tensor, "e c h w"], source: Int[Tensor, "e"]
    ) -> Float[Tensor, "n h w"]:
        """Return the damping of inverse depth of each source, ascending; in the network's units."""
        frames, slot, count = source.unique(return_inverse=True, return_counts=True)
        edges = F.relu(self.conv1(hidden))
        # A product, not scattered sums: the order is fixed, and sums are in single precision.
        fraction = F.one_hot(slot, len(frames)).mT / count[:, None]
        mean = (fraction.to(edges) @ edges.flatten(1)).unflatten(1, edges.shape[1:])
        joined = F.relu(self.conv2(mean))
        return 0.01 * self.eta(joined)[:, 0]


@dataclass(frozen=True)
class EdgeOutput:
    """One update of the edges."""

    hidden: Float[Tensor, "e c h w"]
    delta: Float[Tensor, "e 2 h w"]
    """Correction of the looked-up position, in cells."""
    weight: Float[Tensor, "e 2 h w"]
    """Confidence of x and y in (0, 1)."""


class UpdateOperator(nn.Module):
    """The recurrent part: updates the flow of an edge from the correlation around its target."""

    def __init__(self, hidden: int, motion: int) -> None:
        """Arguments: channels of the hidden state, and of the encoded motion."""
        super().__init__()
        windows = VOLUME_LEVELS * WINDOW
        self.corr_encoder = two_convolutions(windows, hidden, hidden, 1, 3, nn.ReLU())
        self.flow_encoder = two_convolutions(4, hidden, motion, 7, 3, nn.ReLU())
        self.gru = ConvGru(hidden, 2 * hidden + motion)
        self.delta = two_convolutions(hidden, hidden, 2, 3, 3)
        self.weight = two_convolutions(hidden, hidden, 2, 3, 3, nn.Sigmoid())
        self.agg = GraphAggregation(hidden)

    def forward(
        self,
        hidden: Float[Tensor, "e c h w"],
        static: Float[Tensor, "e c h w"],
        correlation: Float[Tensor, "e 196 h w"],
        motion: Float[Tensor, "e 4 h w"],
    ) -> EdgeOutput:
        """``correlation`` at the present positions, ``motion`` of :func:`motion_features`."""
        inputs = [static, self.corr_encoder(correlation), self.flow_encoder(motion)]
        hidden = self.gru(hidden, torch.cat(inputs, 1))
        return EdgeOutput(hidden, self.delta(hidden), self.weight(hidden))


class DroidNetwork(nn.Module):
    """All parts, with the parameters of the public weights."""

    def __init__(self, base: int = 32) -> None:
        """``base`` channels of the encoders at half resolution: 32 in the public weights."""
        super().__init__()
        features = 4 * base  # of matching, of the hidden state and of the static context
        self.fnet = DroidEncoder(base, features, norm=True)
        self.cnet = DroidEncoder(base, 2 * features, norm=False)
        self.update = UpdateOperator(features, 2 * base)

    def features(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c h8 w8"]:
        """Compute matching features of images; RGB in [0, 1], sides divisible by 8."""
        return self.fnet(normalised(images))

    def context(
        self, images: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n c h8 w8"], Float[Tensor, "n c h8 w8"]]:
        """Compute the initial hidden state of edges from the image, and its static context."""
        hidden, static = self.cnet(normalised(images)).chunk(2, 1)
        return hidden.tanh(), F.relu(static)


def motion_features(
    position: Float[Tensor, "e h w 2"], target: Float[Tensor, "e h w 2"]
) -> Float[Tensor, "e 4 h w"]:
    """Return the flow at the present position, and its offset to the last target; in cells, at most
    64."""
    height, width = position.shape[1:3]
    flow = position - cell_positions(height, width, position)
    both = torch.cat([flow, target - position], -1)
    return both.clamp(-64.0, 64.0).permute(0, 3, 1, 2)


def load_droid(state: Mapping[str, Tensor]) -> DroidNetwork:
    """Load the network with the public weights ``droid.pth``.

    The names there begin with ``module.``, and the two heads have unused outputs.
    """
    plain = {name.removeprefix("module."): value for name, value in state.items()}
    plain.update({name: plain[name][:2] for name in TRIMMED if name in plain})
    network = DroidNetwork()
    try:
        network.load_state_dict(plain)
    except RuntimeError as error:
        reason = str(error).partition("\n")[2] or str(error)
        raise InputError(f"These are not the weights of DROID-SLAM: {in_short(reason)}") from error
    return network.eval().requires_grad_(False)
