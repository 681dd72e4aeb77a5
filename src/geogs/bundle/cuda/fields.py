"""Fields on the sample grid on the GPU: filling holes, propagating depth from view to view."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.cuda.linear_edges import block_size
from geogs.bundle.fields import GridFields
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.world.grid import OFFSET, STRIDE, SampleGrid
from geogs.world.keyframes import Keyframe

SOURCE = Path(__file__).with_name("fields.cu")
MOST_THREADS = 1024
"""Most threads of a block."""


def _pyramid_size(grid: SampleGrid) -> int:
    """Return the number of floats of the coarser levels of one field and its confidence."""
    width = grid.width
    height = grid.height
    total = 0
    while min(width, height) > 2:
        width, height = -(-width // 2), -(-height // 2)
        total += 2 * width * height
    return total


class CudaFields(GridFields):
    """Operations on the fields of one grid on the GPU."""

    def fill(
        self, values: Float[Tensor, "*n p"], confidence: Float[Tensor, "*n p"]
    ) -> Float[Tensor, "*n p"]:
        """Fill all fields in one launch."""
        values = values.contiguous()
        confidence = confidence.contiguous()
        out = torch.empty_like(values)
        size = _pyramid_size(self.grid)
        count = out.numel() // self.grid.size
        kernels_for(SOURCE, values.device)["fill_fields"](
            count,
            block_size(self.grid.size, MOST_THREADS),
            values,
            confidence,
            self.grid.width,
            self.grid.height,
            size,
            values.new_empty(count * size),
            out,
        )
        return out

    def transfer(
        self,
        T_ji: Float[Tensor, "4 4"],
        inverse_depth: Float[Tensor, "p"],
        information: Float[Tensor, "p"],
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        first = torch.zeros(1, dtype=torch.long)
        depth, propagated = self._propagate(
            T_ji[None],
            torch.eye(4).to(T_ji)[None],
            first,
            inverse_depth[None],
            information[None],
            reproject=False,
        )
        return depth[0], propagated[0]

    def reproject(
        self, keyframes: Sequence[Keyframe], T_cw: Sequence[Float[Tensor, "4 4"]]
    ) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
        rows = {k.id: k for k in keyframes}
        slot = {id: n for n, id in enumerate(rows)}
        return self._propagate(
            torch.stack(list(T_cw)),
            torch.stack([k.T_cw for k in rows.values()]),
            torch.tensor([slot[k.id] for k in keyframes]),
            torch.stack([k.inverse_depth for k in rows.values()]),
            torch.stack([k.information for k in rows.values()]),
            reproject=True,
        )

    def _propagate(
        self,
        T: Float[Tensor, "n 4 4"],
        T_source: Float[Tensor, "m 4 4"],
        source: Int[Tensor, "n"],
        inverse_depth: Float[Tensor, "m p"],
        information: Float[Tensor, "m p"],
        reproject: bool,
    ) -> tuple[Tensor, Tensor]:
        """Transfer depth of sources to views at T (world to camera), which have none of their own.

        Returns inverse depth (n, p) and information (n, p) in the views, or, with ``reproject``,
        the pixels (n, p, 2) of the sources' cells in the views and of the views' cells in the
        sources.
        """
        grid = self.grid
        camera = self.grid.camera
        n = len(T)
        device = inverse_depth.device
        poses = to_device(torch.cat([T, T_source]), device)
        rows = to_device(source, device, torch.int32)
        size = 2 * grid.size + _pyramid_size(grid)
        memory = inverse_depth.new_empty(n * (size + grid.size))
        scratch = memory[: n * size]
        depth = memory[n * size :]
        shape = (2, n, grid.size, 2) if reproject else (n, grid.size)
        out = inverse_depth.new_empty(shape)
        there, back = out.unbind() if reproject else (None, None)
        kernels_for(SOURCE, device)["carry_depth"](
            n, block_size(grid.size, MOST_THREADS), poses[:n], poses[n:], rows, inverse_depth,
            information, grid.rays, grid.width, grid.height, OFFSET, STRIDE, *camera.numbers,
            size, scratch, depth, None if reproject else out, there, back,
        )  # fmt: skip
        if there is None or back is None:
            return depth.reshape(n, -1), out
        return there, back
