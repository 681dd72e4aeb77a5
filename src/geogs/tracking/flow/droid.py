"""The flow operator of DROID-SLAM: recurrent, with a hidden state for every directed edge.

This module converts between the network's conventions and ours:

- Its cells are centred on the pixels (8 c, 8 r) of its input, those of the sample grid on
  (4 + 8 c, 4 + 8 r) of the working image. Its input is the image without the first four rows and
  columns (and extended by up to four at the other end), so the cells coincide exactly, and a
  position of x cells is at pixel 4 + 8 x.
- A weight w in (0, 1) enters DROID-SLAM's adjustment as 0.001 w with residuals in cells. Only the
  ratio of that to the damping was ever learned, so a scale is free here: a weight of 1 counts as a
  match of deviation ``DroidOptions.deviation`` pixels. Residuals in pixels are 8 times those in
  cells, so all curvatures are ``64 / (0.001 deviation^2)`` times those of DROID-SLAM, and so must
  be its damping, ``0.2 eta + 1e-7``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.gpu.transfer import to_device, upload
from geogs.tracking.flow.cell_texture import cell_structure
from geogs.tracking.flow.droid_network import DroidNetwork, motion_features, on_cells
from geogs.tracking.flow.flow_operator import Memories, check_image_size
from geogs.tracking.flow.lookup import CorrelationVolume
from geogs.types import FlowMatch
from geogs.world.grid import OFFSET, STRIDE, SampleGrid


@dataclass(frozen=True)
class DroidOptions:
    """Numbers of updates, and interpretation of the network's output."""

    updates: int = 2
    """Updates of a measurement that starts from a reprojection; nothing is adjusted in between."""
    fine_updates: int = 4
    """Updates of a precise measurement."""
    cold_updates: int = 8
    """Updates of a measurement without a start."""
    deviation: float = 0.3
    """Standard deviation of a match of weight 1, pixels."""
    min_confidence: float = 0.05
    """Least mean weight of a match."""
    edges_at_once: int = 32
    """Directed edges that go through the network together; bounds memory."""


@dataclass(frozen=True)
class DroidImage:
    """An image encoded by the operator, on the device; half precision on a GPU."""

    features: Float[Tensor, "c h w"]
    """Matching features."""
    hidden: Float[Tensor, "c h w"]
    """Initial hidden state of an edge from this image."""
    static: Float[Tensor, "c h w"]
    """Static context, an input of every update."""
    grey: UInt8[Tensor, "y x"]
    texture: float
    """Fraction of the cells with structure."""


@dataclass(frozen=True)
class DroidMemory:
    """State of a directed edge."""

    hidden: Float[Tensor, "c h w"]
    target: Float[Tensor, "h w 2"]
    """Last positions from the network, in cells."""


class DroidFlow:
    """DROID-SLAM's network on one grid, on the grid's device."""

    def __init__(
        self, grid: SampleGrid, network: DroidNetwork, options: DroidOptions | None = None
    ) -> None:
        self.grid = grid
        self.options = options or DroidOptions()
        self.device = torch.device(grid.device)
        self.network = network.to(self.device).eval()

    @torch.no_grad()
    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> DroidImage:
        check_image_size(image, self.grid.camera)
        rgb = upload(image, self.device).permute(2, 0, 1)[None]
        with self._precision():
            shown = on_cells(rgb.float() / 255)
            features = self.network.features(shown)
            hidden, static = self.network.context(shown)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        textured = cell_structure(grey).textured_fraction
        return DroidImage(features[0], hidden[0], static[0], upload(grey, self.device), textured)

    def texture(self, encoded: DroidImage) -> float:
        return encoded.texture

    def grey(self, encoded: DroidImage) -> Float[Tensor, "y x"]:
        return encoded.grey.float()

    @torch.no_grad()
    def measure(
        self,
        first: Sequence[DroidImage],
        second: Sequence[DroidImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        source = [*first, *second]
        target = [*second, *first]
        known = memory or [(None, None)] * len(first)
        before: list[DroidMemory | None] = [pair[way] for way in (0, 1) for pair in known]
        updates = self.options.fine_updates if fine else self.options.updates
        if forward is None or backward is None:
            updates = self.options.cold_updates
            start = self.grid.pixels.expand(len(source), -1, -1)
        else:
            start = torch.cat([forward, backward])
        parts = []
        for begin in range(0, len(source), self.options.edges_at_once):
            c = slice(begin, begin + self.options.edges_at_once)
            parts.append(self._revise(source[c], target[c], start[c], before[c], updates))
        hidden, position, confidence = (torch.cat(p) for p in zip(*parts, strict=True))
        pixels, weight = self._weighed(position, confidence)
        damping = self._damping(source, hidden)
        # Copies, so that one edge does not keep all in memory.
        kept = tuple(
            DroidMemory(h.clone(), p.clone()) for h, p in zip(hidden, position, strict=True)
        )
        there, back = (
            FlowMatch(pixels[way], weight[way], damping[way], kept[way])
            for way in (slice(None, len(first)), slice(len(first), None))
        )
        return there, back

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.float16, enabled=self.grid.on_gpu)

    def _revise(
        self,
        source: Sequence[DroidImage],
        target: Sequence[DroidImage],
        start: Float[Tensor, "d p 2"],
        before: Sequence[DroidMemory | None],
        updates: int,
    ) -> tuple[Float[Tensor, "d c h w"], Float[Tensor, "d h w 2"], Float[Tensor, "d h w 2"]]:
        """Run the updates of some directed edges from the positions ``start``, in pixels.

        Returns their hidden states, positions in cells and confidence of these.
        """
        shape = (len(source), self.grid.height, self.grid.width, 2)
        position = (start.reshape(shape) - OFFSET) / STRIDE
        # Points close to or behind the second camera can project anywhere.
        position = position.nan_to_num(1e4).clamp(-1e4, 1e4)
        hidden = torch.stack(
            [s.hidden if m is None else m.hidden for s, m in zip(source, before, strict=True)]
        )
        last = torch.stack(
            [p if m is None else m.target for p, m in zip(position, before, strict=True)]
        )
        static = torch.stack([s.static for s in source])
        weight = torch.zeros_like(position)
        with self._precision():
            a, b = (torch.stack([image.features for image in x]) for x in (source, target))
            lookup = CorrelationVolume(a, b)
            for _ in range(updates):
                out = self.network.update(
                    hidden, static, lookup(position), motion_features(position, last)
                )
                hidden = out.hidden
                weight = out.weight.permute(0, 2, 3, 1).float()
                # The best guess of the reprojection after an adjustment.
                position = last = position + out.delta.permute(0, 2, 3, 1).float()
        return hidden, position, weight

    def _damping(
        self, source: Sequence[DroidImage], hidden: Float[Tensor, "d c h w"]
    ) -> Float[Tensor, "d p"]:
        """Return damping of the inverse depth of each edge's source, from its outgoing edges."""
        slot: dict[int, int] = {}
        slots = [slot.setdefault(id(image), len(slot)) for image in source]
        index = to_device(torch.tensor(slots), self.device)
        with self._precision():
            eta = self.network.update.agg(hidden, index).float()
        factor = STRIDE**2 / (0.001 * self.options.deviation**2)
        return factor * (0.2 * eta.flatten(1) + 1e-7)[index]

    def _weighed(
        self, position: Float[Tensor, "d h w 2"], confidence: Float[Tensor, "d h w 2"]
    ) -> tuple[Float[Tensor, "d p 2"], Float[Tensor, "d p 2"]]:
        """Convert positions in cells to pixels and inverse variances; zero without a match."""
        pixels = (OFFSET + STRIDE * position).flatten(1, 2)
        confidence = confidence.flatten(1, 2)
        found = (confidence.mean(-1) > self.options.min_confidence) & self.grid.inside(pixels, 0.0)
        return pixels, confidence * found[..., None] / self.options.deviation**2
