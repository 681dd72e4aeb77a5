"""Flow by RAFT, whose weights the user supplies.

Features and context are computed once per image; all pairs of a call, both ways, go through the
recurrent updates together. The reprojection, where there is one, is the flow that the updates
start from. What confidence there is comes from comparing the flow there with the flow back.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from geogs.errors import InputError
from geogs.gpu.transfer import to_device
from geogs.networks.weights import read_tensors
from geogs.tracking.flow.base import Memories
from geogs.tracking.flow.correlation import CorrelationVolume, LocalCorrelation
from geogs.tracking.flow.raft_layout import network_from
from geogs.tracking.flow.raft_network import CELL, RaftFeatures
from geogs.tracking.flow.texture import grey_levels, textured_fraction
from geogs.types import FlowMatch
from geogs.world.grid import OFFSET, STRIDE, SampleGrid

FAR = 1e3
"""Stands for a position outside the image, in pixels."""


@dataclass(frozen=True)
class RaftOptions:
    """How the flow is found and what it counts."""

    cold_iterations: int = 20
    """Updates where nothing is known of the flow."""
    warm_iterations: int = 8
    """Updates of a reprojection that is right to a few pixels."""
    coarse_iterations: int = 4
    """The same where a less precise measurement is enough."""
    without_volume: bool = False
    """Correlate around the flow instead of everywhere: slower, in little memory."""
    memory: int = 1 << 29
    """Bytes that the pairs that are worked on together may take, about."""
    max_disagreement: float = 1.0
    """Forward and backward flow that differ by more pixels are no match."""
    deviation: float = 0.15
    """Standard deviation of a match on which both agree, pixels; not fitted to trained weights."""
    deviation_by_disagreement: float = 0.8
    """What a pixel of disagreement adds to it."""


@dataclass(frozen=True)
class RaftImage:
    """An image as the operator keeps it, on the grid's device; half precision on a GPU."""

    features: RaftFeatures
    """Of a batch of one."""
    grey: UInt8[Tensor, "h w"]
    texture: float
    """Fraction of the grid with structure."""


class RaftFlow:
    """The RAFT operator on one grid, on the grid's device."""

    def __init__(self, grid: SampleGrid, weights: Path, options: RaftOptions | None = None) -> None:
        """Load the network, large or small, from a published checkpoint.

        Raises InputError if the file is none.
        """
        self.grid = grid
        self.options = options or RaftOptions()
        self.device = torch.device(grid.device)
        network = network_from(read_tensors(weights), str(weights))
        self.network = network.to(self.device)

    @torch.no_grad()
    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> RaftImage:
        camera = self.grid.camera
        if image.shape != (camera.height, camera.width, 3):
            raise InputError(
                f"An image of shape {image.shape} does not fit a camera of "
                f"{camera.width} x {camera.height} pixels."
            )
        with self._precision():
            found = self.network.encode(padded(torch.from_numpy(image).to(self.device)))
        dtype = torch.float16 if self.grid.on_gpu else torch.float32
        kept = (t.to(dtype) for t in (found.features, found.hidden, found.context))
        grey = grey_levels(image)
        shown = to_device(torch.from_numpy(grey), self.device)
        return RaftImage(RaftFeatures(*kept), shown, textured_fraction(grey))

    def texture(self, encoded: RaftImage) -> float:
        return encoded.texture

    def grey(self, encoded: RaftImage) -> Float[Tensor, "h w"]:
        return encoded.grey.float()

    @torch.no_grad()
    def measure(
        self,
        first: Sequence[RaftImage],
        second: Sequence[RaftImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        options = self.options
        is_cold = forward is None or backward is None
        warm = options.warm_iterations if fine else options.coarse_iterations
        parts = []
        at_once = self._pairs_at_once(first[0])
        for at in range(0, len(first), at_once):
            pairs = slice(at, at + at_once)
            images = [*first[pairs], *second[pairs]], [*second[pairs], *first[pairs]]
            start = None
            if forward is not None and backward is not None:
                positions = torch.cat([forward[pairs], backward[pairs]])
                start = start_in_cells(self.grid, positions, *self._cells(first[0]))
            flow = self._flow(*images, start, options.cold_iterations if is_cold else warm)
            there, back = checked_matches(self.grid, flow, options)
            parts.append((there.pixels, there.weight, back.pixels, back.weight))
        p, w, q, v = (torch.cat(part) for part in zip(*parts, strict=True))
        return FlowMatch(p, w), FlowMatch(q, v)

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.float16, enabled=self.grid.on_gpu)

    @staticmethod
    def _cells(image: RaftImage) -> tuple[int, int]:
        """Rows and columns of the network's cells."""
        *_, height, width = image.features.features.shape
        return height, width

    def _pairs_at_once(self, image: RaftImage) -> int:
        """Pairs whose correlation and activations, both ways, fit into the memory."""
        height, width = self._cells(image)
        cells = height * width
        numbers = cells * (3000 if self.options.without_volume else 3000 + 4 * cells // 3)
        size = 2 if self.grid.on_gpu else 4
        return max(1, self.options.memory // (2 * size * numbers))

    def _flow(
        self,
        first: Sequence[RaftImage],
        second: Sequence[RaftImage],
        start: Float[Tensor, "d 2 h w"] | None,
        iterations: int,
    ) -> Float[Tensor, "d 2 y x"]:
        """Flow of every pixel of the images, without what was padded."""
        shape = self.network.shape
        lookup = LocalCorrelation if self.options.without_volume else CorrelationVolume
        a = RaftFeatures(*(torch.cat(part) for part in zip(*map(_parts, first), strict=True)))
        b = torch.cat([image.features.features for image in second])
        with self._precision():
            correlation = lookup(a.features, b, shape.levels, shape.radius)
            found = self.network.estimate(a, correlation, start, iterations)
        camera = self.grid.camera
        return found.pixels[..., : camera.height, : camera.width]


def _parts(image: RaftImage) -> tuple[Tensor, Tensor, Tensor]:
    found = image.features
    return found.features, found.hidden, found.context


def padded(image: UInt8[Tensor, "y x 3"]) -> Float[Tensor, "1 3 h8 w8"]:
    """RGB in [-1, 1], its last row and column repeated until both sides are multiples of 8.

    Only below and to the right, so that pixel coordinates stay as they are.
    """
    values = 2 * (image.permute(2, 0, 1)[None].float() / 255) - 1
    down, across = (-n % CELL for n in image.shape[:2])
    return functional.pad(values, (0, across, 0, down), mode="replicate")


def sample_flow(
    flow: Float[Tensor, "d 2 y x"], points: Float[Tensor, "d p 2"]
) -> tuple[Float[Tensor, "d p 2"], Bool[Tensor, "d p"]]:
    """Bilinear flow at pixel positions, and whether they are inside the image."""
    size = points.new_tensor([flow.shape[-1], flow.shape[-2]])
    inside = ((points >= 0) & (points <= size - 1)).all(-1)
    normalised = (2 * points + 1) / size - 1
    found = functional.grid_sample(
        flow, normalised[:, None].nan_to_num(-2.0), padding_mode="border", align_corners=False
    )
    return found[:, :, 0].mT, inside


def start_in_cells(
    grid: SampleGrid, positions: Float[Tensor, "d p 2"], height: int, width: int
) -> Float[Tensor, "d 2 h w"]:
    """Flow of the network's cells, in cells, from positions in pixels of the grid's cells."""
    limit = max(grid.camera.width, grid.camera.height)
    flow = (positions.float() - grid.pixels).nan_to_num(0.0).clamp(-limit, limit) / CELL
    flow = flow.mT.reshape(len(flow), 2, grid.height, grid.width)
    # A cell of the network lies half a cell before that of the grid: in the middle of four.
    sides = (1, width - grid.width, 1, height - grid.height)
    return functional.avg_pool2d(functional.pad(flow, sides, mode="replicate"), 2, stride=1)


def checked_matches(
    grid: SampleGrid, flow: Float[Tensor, "d 2 y x"], options: RaftOptions
) -> tuple[FlowMatch, FlowMatch]:
    """Matches of the grid's cells, there and back.

    ``flow`` is of every pixel: of the first images of all pairs, then of the second ones. A match
    counts if the way back from where it leads comes home; how far it misses gives its deviation.
    """
    pairs = len(flow) // 2
    sampled = flow[..., OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].flatten(2).mT
    pixels = grid.pixels + sampled
    returned, known = sample_flow(flow.roll(pairs, 0), pixels)
    disagreement = (sampled + returned).norm(dim=-1)
    matched = known & grid.inside(pixels) & (disagreement < options.max_disagreement)
    deviation = options.deviation + options.deviation_by_disagreement * disagreement
    weight = torch.where(matched, deviation**-2, 0.0)[..., None].expand(-1, -1, 2).contiguous()
    pixels = torch.where(torch.isfinite(pixels), pixels, FAR)
    return FlowMatch(pixels[:pairs], weight[:pairs]), FlowMatch(pixels[pairs:], weight[pairs:])
