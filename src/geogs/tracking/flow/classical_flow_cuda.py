"""Flow without a network on a GPU: dense inverse search with variational refinement.

As in the operator on the CPU, the second image is warped to the first by the present reprojection
and adjusted to its local brightness, the residual flow is estimated by dense inverse search
(Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016) from coarse to fine, and
the warp is added back. All directed pairs of a call go through each kernel together, and nothing is
read back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from geogs.gpu.kernels import Kernel, kernels_for
from geogs.gpu.transfer import to_device
from geogs.tracking.flow.cell_texture import MIN_STRUCTURE, SHARP, UNINFORMED
from geogs.tracking.flow.classical_flow import (
    COARSE_DEVIATION,
    DEVIATION,
    MAX_DISAGREEMENT,
    SMALL_IMAGE,
)
from geogs.tracking.flow.flow_operator import Memories, check_image_size
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

SOURCES = Path(__file__).parents[1] / "cuda"
TILE = 32
"""Edge in pixels of the tile of a block of the pyramid kernels."""
PATCH = 8
"""Pixels along the edge of a patch."""
REFINE_INNER = 24
"""Edge in pixels of the output of a block of the refinement."""
MEAN_LEVEL = 3
"""Pyramid level on which local brightness is compared."""
LEVELS = 6
"""Levels of a pyramid, including the image itself."""
PAIRS_AT_ONCE = 48
"""Pairs whose images and flows are in memory together."""
WARM_LEVELS = 4
"""Pyramid levels searched where the start is right to a few pixels."""
ITERATIONS = 6
"""Gauss-Newton steps of a patch."""
COLD_REACHES = (4, 2, 1)
"""Distances, in patches, of neighbours whose motions a patch tries, pass by pass; cold starts."""
REFINEMENTS = (5, 3)
"""Linearisations of the variational refinement at the finest level and at the others."""
SWEEPS = (10, 20)
"""Relaxation sweeps of each, the same way."""
SMOOTHNESS = 10.0
"""Weight alpha of the smoothness term; less lets more noise in, more blurs depth steps."""
GRADIENTS = 10.0
"""Weight gamma of gradient constancy."""
BRIGHTNESS = 1.0
"""Weight delta of brightness constancy."""
ZETA = 0.1
"""Constant added to the norms that divide the data terms, grey levels / pixel."""
EPSILON = 0.001
"""Threshold between the quadratic and the linear part of the penalty."""
RELAXATION = 1.6
"""Over-relaxation of the sweeps."""


@dataclass(frozen=True)
class CudaImage:
    """An image encoded by the operator, on the device."""

    data: Float[Tensor, "n"]
    """Grey pyramid, then local means of the brightness."""
    textured: Int[Tensor, "1"]
    """Number of cells with structure, int32."""


class _Layout:
    """Sizes of the levels and of the parts of an image's buffer."""

    def __init__(self, grid: SampleGrid) -> None:
        self.sizes = [(grid.camera.width, grid.camera.height)]
        for _ in range(LEVELS - 1):
            w, h = self.sizes[-1]
            self.sizes.append(((w + 1) // 2, (h + 1) // 2))
        self.pyramid = sum(w * h for w, h in self.sizes)
        w, h = self.sizes[MEAN_LEVEL]
        self.means = w * h
        self.total = self.pyramid + self.means
        self.coarsest = max(k for k, size in enumerate(self.sizes) if min(size) >= PATCH or k == 0)
        self.cells = (grid.width, grid.height)

    def patches(self, level: int) -> int:
        """Return the number of patches of a level."""
        # One begins every four pixels.
        across, down = (-(-(n - PATCH) // 4) + 1 for n in self.sizes[level])
        return across * down


class CudaClassicalFlow:
    """The dense-inverse-search operator on one grid, on the grid's device."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid
        self.device = torch.device(grid.device)
        self._layout = _Layout(grid)
        self._kernels: dict[str, Kernel] = {}
        for name in ("image", "search", "refine", "match"):
            loaded: Mapping[str, Kernel] = kernels_for(SOURCES / f"flow_{name}.cu", self.device)
            self._kernels.update(loaded)

    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> CudaImage:
        layout = self._layout
        grid = self.grid
        check_image_size(image, grid.camera)
        staged = torch.empty(image.shape, dtype=torch.uint8, pin_memory=self.device.type == "cuda")
        staged.numpy()[...] = image
        rgb = staged.to(self.device, non_blocking=True)
        data = torch.empty(layout.total, device=self.device)
        textured = torch.empty(1, dtype=torch.int32, device=self.device)
        size = layout.sizes[0]
        self._kernels["flow_grey"](
            _blocks(size, TILE), (TILE, 8), rgb, data, textured, *size, LEVELS
        )
        count = -(-(grid.size + layout.means) // 8)
        sizes = (*size, *layout.cells, layout.pyramid)
        self._kernels["flow_structure"](count, (32, 8), data, textured, *sizes, MIN_STRUCTURE)
        return CudaImage(data, textured)

    def texture(self, encoded: CudaImage) -> float:
        return float(encoded.textured.item()) / self.grid.size

    def grey(self, encoded: CudaImage) -> Float[Tensor, "h w"]:
        width, height = self._layout.sizes[0]
        return encoded.data[: width * height].reshape(height, width)

    def measure(
        self,
        first: Sequence[CudaImage],
        second: Sequence[CudaImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        if forward is None or backward is None:
            start = None
        else:
            start = (forward.float().contiguous(), backward.float().contiguous())
        fine = fine or self.grid.camera.long_edge <= SMALL_IMAGE
        parts = []
        for at in range(0, len(first), PAIRS_AT_ONCE):
            part = slice(at, at + PAIRS_AT_ONCE)
            begin = None if start is None else (start[0][part], start[1][part])
            parts.append(self._measure([*first[part], *second[part]], begin, 0 if fine else 1))
        pixels, weight = (
            p[0] if len(p) == 1 else torch.cat(p, 1) for p in zip(*parts, strict=True)
        )
        return FlowMatch(pixels[0], weight[0]), FlowMatch(pixels[1], weight[1])

    def _measure(
        self, images: Sequence[CudaImage], start: tuple[Tensor, Tensor] | None, finest: int
    ) -> tuple[Float[Tensor, "2 e p 2"], Float[Tensor, "2 e p 2"]]:
        layout = self._layout
        grid = self.grid
        pairs = len(images) // 2
        size = layout.sizes[0]
        pointers = torch.tensor([image.data.data_ptr() for image in images])
        table = to_device(pointers, self.device)
        forward, backward = (None, None) if start is None else start
        warped = self._warped(table, forward, backward)
        flow = self._coarse_to_fine(table, warped, start is None, finest)
        width, height = layout.sizes[finest]
        found = torch.empty(2 * pairs, height, width, device=self.device)
        blocks = (*_blocks(layout.sizes[finest], 32, 8), 2 * pairs)
        self._kernels["flow_found"](
            blocks, (32, 8), warped, flow, found, layout.pyramid, *size, finest
        )
        pixels = torch.empty(2, pairs, grid.size, 2, device=self.device)
        weight = torch.empty_like(pixels)
        scale = COARSE_DEVIATION if finest else 1.0
        limits = (SHARP, UNINFORMED, MAX_DISAGREEMENT, *(scale * d for d in DEVIATION))
        given = (table, flow, forward, backward, found)
        cells = (-(-grid.size // 8), 2 * pairs)
        self._kernels["flow_match"](
            cells, (32, 8), *given, pixels, weight, pairs, *size, *layout.cells, finest, *limits
        )
        return pixels, weight

    def _warped(
        self,
        table: Int[Tensor, "d"],
        forward: Float[Tensor, "e p 2"] | None,
        backward: Float[Tensor, "e p 2"] | None,
    ) -> Float[Tensor, "d n"]:
        """Return pyramids of the second images, warped and with the first images' brightness."""
        layout = self._layout
        directed = len(table)
        size = layout.sizes[0]
        stride = layout.pyramid
        warped = torch.empty(directed, stride, device=self.device)
        gain = torch.empty(directed, layout.means, device=self.device)
        blocks = (*_blocks(size, TILE), directed)
        sizes = (directed // 2, stride, *size, *layout.cells)
        self._kernels["flow_warp"](
            blocks, (TILE, 8), table, forward, backward, warped, *sizes, LEVELS
        )
        means = (-(-layout.means // 8), directed)
        self._kernels["flow_gain"](means, (32, 8), table, warped, gain, stride, *size, stride)
        pixels = (-(-stride // 256), directed)
        self._kernels["flow_brighten"](pixels, 256, warped, gain, stride, *size, LEVELS)
        return warped

    def _coarse_to_fine(
        self, table: Int[Tensor, "d"], warped: Float[Tensor, "d n"], cold: bool, finest: int
    ) -> Float[Tensor, "d q 2"]:
        """Compute dense flow at level ``finest``, row by row, in its pixels."""
        layout = self._layout
        directed = len(table)
        sizes = (layout.pyramid, *layout.sizes[0])
        coarsest = layout.coarsest if cold else min(WARM_LEVELS - 1, layout.coarsest)
        flow: Tensor | None = None
        for level in range(coarsest, finest - 1, -1):
            width, height = layout.sizes[level]
            count = layout.patches(level)
            patches: Tensor | None = None
            for reach in (0, *(COLD_REACHES if cold else ())):
                found = torch.empty(directed, count, 2, device=self.device)
                images = (table, warped, flow, patches)
                settings = (level, reach, ITERATIONS)
                blocks = (-(-count * PATCH // 256), directed)
                self._kernels["flow_search"](blocks, 256, *images, found, *sizes, *settings)
                patches = found
            flow = torch.empty(directed, width * height, 2, device=self.device)
            other = torch.empty_like(flow)
            tiles = (*_blocks(layout.sizes[level], 32, 8), directed)
            self._kernels["flow_densify"](
                tiles, (32, 8), table, warped, patches, flow, *sizes, level
            )
            is_coarse = level > finest
            for _ in range(REFINEMENTS[is_coarse]):
                self._refine(table, warped, flow, other, level, SWEEPS[is_coarse])
                flow, other = other, flow
        assert flow is not None
        return flow

    def _refine(
        self, table: Tensor, warped: Tensor, flow: Tensor, refined: Tensor, level: int, sweeps: int
    ) -> None:
        layout = self._layout
        blocks = (*_blocks(layout.sizes[level], REFINE_INNER), len(table))
        sizes = (layout.pyramid, *layout.sizes[0], level)
        weights = (SMOOTHNESS, GRADIENTS, BRIGHTNESS, ZETA**2, EPSILON**2, RELAXATION)
        self._kernels["flow_refine"](
            blocks, (32, 8), table, warped, flow, refined, *sizes, sweeps, *weights
        )


def _blocks(size: tuple[int, int], width: int, height: int | None = None) -> tuple[int, int]:
    """Return how many blocks of ``width`` x ``height`` (default: square) cover an image."""
    return -(-size[0] // width), -(-size[1] // (height or width))
