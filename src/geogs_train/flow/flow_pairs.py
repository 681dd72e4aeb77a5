"""Training batches of the flow network from clips: images, edges, true flow, starts."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.tracking.flow.lookup import Edges
from geogs.tracking.flow.network_parts import cell_pixels
from geogs.world.grid import OFFSET, STRIDE
from geogs_synth.clips.clip_batch import ClipBatch
from geogs_synth.clips.room_options import PAPERED
from geogs_train.flow.starts import StartOptions, disturbed_starts

REPEATING = 5.0
"""Largest disturbance for repeating patterns, pixels: the right repeat is then the nearest."""
MARGIN = 48
"""Pixels outside the second image beyond which cells do not count."""
PROBE = 1.0, 100.0
"""Least and largest distance of a probe from the truth, pixels."""


@dataclass(frozen=True)
class FlowBatch:
    """Directed pairs of images with exact flow."""

    images: Float[Tensor, "n 3 h w"]
    edges: Edges
    truth: Float[Tensor, "e h w 2"]
    """True position of every pixel in the second image."""
    visible: Bool[Tensor, "e h w"]
    known: Bool[Tensor, "e h w"]
    """Mask of the pixels in front of the second camera and near enough to its image."""
    start: Float[Tensor, "e p 2"]
    probe: Float[Tensor, "e p 2"]
    """Positions near the truth, from which descriptors have to point to it."""

    @property
    def flow(self) -> Float[Tensor, "e h w 2"]:
        """True motion of every pixel."""
        rows, columns = (
            torch.arange(n, dtype=self.truth.dtype, device=self.truth.device)
            for n in self.truth.shape[1:3]
        )
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        return self.truth - torch.stack([u, v], -1)

    def at_cells(self, field: Tensor) -> Tensor:
        """Sample a field (e, h, w, ...) at the cells, row by row."""
        return _at_cells(field).flatten(1, 2)


def flow_batch(clips: ClipBatch, options: StartOptions, generator: torch.Generator) -> FlowBatch:
    """Make a batch of every ordered pair of neighbouring views of every clip."""
    count, views, _, height, width = clips.images.shape
    pairs = [(i, j) for i in range(views) for j in (i - 1, i + 1) if 0 <= j < views]
    base = views * torch.arange(count, dtype=torch.int32, device=clips.images.device)
    edges = Edges(torch.cat([base + i for i, _ in pairs]), torch.cat([base + j for _, j in pairs]))
    flows = [clips.flow(i, j) for i, j in pairs]
    truth = torch.cat([f.pixels for f in flows])
    limit = truth.new_tensor([width - 1 + MARGIN, height - 1 + MARGIN])
    near = ((truth > -MARGIN) & (truth < limit)).all(-1)
    known = torch.cat([f.valid for f in flows]) & near
    visible = torch.cat([f.visible for f in flows]) & known
    starts = [
        _starts(clips, pair, flow.pixels, options, generator)
        for pair, flow in zip(pairs, flows, strict=True)
    ]
    start = torch.cat(starts).flatten(1, 2)
    probe = _at_cells(truth).flatten(1, 2) + _offsets(start, generator)
    images = clips.images.flatten(0, 1)
    return FlowBatch(images, edges, truth, visible, known, start, probe)


def _offsets(like: Float[Tensor, "e p 2"], generator: torch.Generator) -> Float[Tensor, "e p 2"]:
    """Offsets of any direction with log-uniform lengths."""
    u = torch.rand(*like.shape, generator=generator, device=like.device)
    low, high = math.log(PROBE[0]), math.log(PROBE[1])
    length = (low + (high - low) * u[..., 0]).exp()
    angle = 2 * math.pi * u[..., 1]
    return length[..., None] * torch.stack([angle.cos(), angle.sin()], -1)


def _at_cells(field: Tensor) -> Tensor:
    return field[:, OFFSET:-3:STRIDE, OFFSET:-3:STRIDE]


def _starts(
    clips: ClipBatch,
    pair: tuple[int, int],
    truth: Tensor,
    options: StartOptions,
    generator: torch.Generator,
) -> Tensor:
    largest = None
    truth = _at_cells(truth)
    if clips.dynamics is not None:
        # A tracker's poses and depths predict the camera's motion only.
        truth = clips.still_flow(_at_cells(clips.points(pair[0])), pair[1])
        largest = torch.full_like(clips.views.intrinsics[:, 0], options.largest)
        largest = torch.where(clips.dynamics.kind == PAPERED, REPEATING, largest)
    depth = _at_cells(clips.depth[:, pair[0]])
    cells = cell_pixels(depth.shape[1], depth.shape[2], depth).reshape(*depth.shape[1:], 2)
    intrinsics = clips.views.intrinsics.float()
    f = intrinsics[:, None, None, :2]
    c = intrinsics[:, None, None, 2:]
    rays = torch.cat([(cells - c) / f, torch.ones_like(depth)[..., None]], -1)
    T_cw = clips.views.T_cw.float()
    T_ji = T_cw[:, pair[1]] @ se3_inverse(T_cw[:, pair[0]])
    return disturbed_starts(
        truth, depth, rays, T_ji, intrinsics, cells, options, generator, largest
    )
