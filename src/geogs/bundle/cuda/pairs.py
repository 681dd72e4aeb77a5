"""Directed pairs of keyframes on the GPU: one launch for any number of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.cuda.dense import block_size
from geogs.gpu.kernels import Kernel, kernels_for
from geogs.gpu.transfer import to_device
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.store import Segment

SOURCE = Path(__file__).with_name("pairs.cu")


@dataclass(frozen=True)
class DirectedPairs:
    """Keyframes and pairs of them, on the device."""

    grid: SampleGrid
    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    source: Int[Tensor, "e"]
    target: Int[Tensor, "e"]

    @classmethod
    def of(cls, store: Segment, directed: Sequence[tuple[int, int]]) -> "DirectedPairs":
        """Pairs (source, target) of keyframe ids."""
        ids = sorted({k for pair in directed for k in pair})
        slot = {k: n for n, k in enumerate(ids)}
        rows = torch.tensor([[slot[i], slot[j]] for i, j in directed], dtype=torch.int32).mT
        inverse_depth = store.inverse_depths(ids)
        device = inverse_depth.device
        rows = to_device(rows.contiguous(), device)
        T = to_device(store.poses(ids), device)
        return cls(store.grid, T, inverse_depth, rows[0], rows[1])

    def __len__(self) -> int:
        return len(self.source)

    def project(self) -> Float[Tensor, "e p 2"]:
        """Where the cells of the sources fall in the targets."""
        grid, c = self.grid, self.grid.camera
        pixels = self.inverse_depth.new_empty(len(self), grid.size, 2)
        self._kernel("project_pairs")(
            len(self), block_size(grid.size), self.T_cw, self.inverse_depth, self.source,
            self.target, grid.rays, grid.size, c.fx, c.fy, c.cx, c.cy, pixels,
        )  # fmt: skip
        return pixels

    def moved(
        self, before: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
    ) -> Float[Tensor, "e"]:
        """Median distance in pixels of the matched cells from where they fell before."""
        grid, c = self.grid, self.grid.camera
        median = self.inverse_depth.new_empty(len(self))
        self._kernel("moved_pairs")(
            len(self), block_size(grid.size), self.T_cw, self.inverse_depth, self.source,
            self.target, grid.rays, grid.size, c.fx, c.fy, c.cx, c.cy, before, weight, median,
            shared=4 * grid.size,
        )  # fmt: skip
        return median

    def distances(self, rotation_weight: float, step: int) -> Float[Tensor, "e"]:
        """``frame_distances`` of the pairs."""
        grid, c = self.grid, self.grid.camera
        distance = self.inverse_depth.new_empty(len(self))
        self._kernel("pair_distances")(
            len(self), min(block_size(grid.size), 128), self.T_cw, self.inverse_depth, self.source,
            self.target, grid.rays, grid.pixels, grid.width, grid.height, step, c.fx, c.fy, c.cx,
            c.cy, c.width - 2, c.height - 2, rotation_weight, distance,
        )  # fmt: skip
        return distance

    def _kernel(self, name: str) -> Kernel:
        return kernels_for(SOURCE, self.inverse_depth.device)[name]
