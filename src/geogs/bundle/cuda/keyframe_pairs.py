"""Directed pairs of keyframes on the GPU: one launch for any number of them."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.cuda.linear_edges import block_size
from geogs.bundle.keyframe_pairs import CELL_STEP, KeyframePairs
from geogs.gpu.kernels import Kernel, kernels_for
from geogs.gpu.transfer import to_device
from geogs.world.keyframes import KeyframeSet

SOURCE = Path(__file__).with_name("pairs.cu")


class CudaPairs(KeyframePairs):
    """Pairs (source, target) of keyframe ids, on the device."""

    def __init__(self, keyframes: KeyframeSet, directed: Sequence[tuple[int, int]]) -> None:
        ids = sorted({k for pair in directed for k in pair})
        slot = {k: n for n, k in enumerate(ids)}
        rows = torch.tensor([[slot[i], slot[j]] for i, j in directed], dtype=torch.int32).mT
        self.grid = keyframes.grid
        self.inverse_depth = keyframes.inverse_depths(ids)
        device = self.inverse_depth.device
        self.source, self.target = to_device(rows.contiguous(), device)
        self.T_cw = to_device(keyframes.poses(ids), device)

    def __len__(self) -> int:
        return len(self.source)

    def project(self) -> Float[Tensor, "e p 2"]:
        grid = self.grid
        c = self.grid.camera
        pixels = self.inverse_depth.new_empty(len(self), grid.size, 2)
        self._kernel("project_pairs")(
            len(self),
            block_size(grid.size),
            self.T_cw,
            self.inverse_depth,
            self.source,
            self.target,
            grid.rays,
            grid.size,
            *c.numbers,
            pixels,
        )
        return pixels

    def moved(
        self, before: Float[Tensor, "e p 2"], weight: Float[Tensor, "e p 2"]
    ) -> Float[Tensor, "e"]:
        grid = self.grid
        c = self.grid.camera
        median = self.inverse_depth.new_empty(len(self))
        self._kernel("moved_pairs")(
            len(self), block_size(grid.size), self.T_cw, self.inverse_depth, self.source,
            self.target, grid.rays, grid.size, *c.numbers, before, weight, median,
            shared=4 * grid.size,
        )  # fmt: skip
        return median

    def distances(self, rotation_weight: float) -> Float[Tensor, "e"]:
        grid = self.grid
        c = self.grid.camera
        distance = self.inverse_depth.new_empty(len(self))
        self._kernel("pair_distances")(
            len(self), min(block_size(grid.size), 128), self.T_cw, self.inverse_depth, self.source,
            self.target, grid.rays, grid.pixels, grid.width, grid.height, CELL_STEP, *c.numbers,
            c.width - 2, c.height - 2, rotation_weight, distance,
        )  # fmt: skip
        return distance

    def _kernel(self, name: str) -> Kernel:
        return kernels_for(SOURCE, self.inverse_depth.device)[name]
