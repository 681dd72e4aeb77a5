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
from geogs.tracking.flow.classical_flow import COARSE_DEVIATION, MAX_DISAGREEMENT, SMALL_IMAGE
from geogs.tracking.flow.flow_operator import Memories, check_image_size
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

SOURCES = Path(__file__).parents[1] / "cuda"
TILE = 32
"""Edge in pixels of the tile of a block of the pyramid kernels."""
PATCH = 8
"""Pixels along the edge of a patch."""
PATCH_STRIDE = 4
"""Pixels between patches."""
REFINE_INNER = 24
"""Edge in pixels of the output of a block of the refinement."""
MEAN_LEVEL = 3
"""Pyramid level on which local brightness is compared."""
LEVELS = 6
"""Levels of a pyramid, including the image itself."""
PAIRS_AT_ONCE = 48
"""Pairs whose images and flows are in memory together."""
DEVIATION = (0.06, 0.8, 3.4)
"""Standard deviation of a match: constant (pixels), by disagreement, by roughness.

As in :func:`geogs.tracking.flow.classical_flow.match_deviation`, fitted to this operator.
"""
WARM_LEVELS = 4
"""Pyramid levels searched where the start is right to a few pixels."""
ITERATIONS = 6
"""Gauss-Newton steps of a patch."""
COLD_REACHES = (4, 2, 1)
"""Distances, in patches, of neighbours whose motions a patch tries, pass by pass; cold starts."""
REFINEMENTS = 5
"""Linearisations of the variational refinement at the finest level."""
COARSE_REFINEMENTS = 3
"""Linearisations at the other levels."""
SWEEPS = 10
"""Relaxation sweeps of each at the finest level."""
COARSE_SWEEPS = 20
"""Relaxation sweeps at the other levels."""
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
        self.width, self.height = grid.camera.width, grid.camera.height
        self.sizes = [(self.width, self.height)]
        for _ in range(LEVELS - 1):
            w, h = self.sizes[-1]
            self.sizes.append(((w + 1) // 2, (h + 1) // 2))
        self.pyramid = sum(w * h for w, h in self.sizes)
        w, h = self.sizes[MEAN_LEVEL]
        self.means = w * h
        self.total = self.pyramid + self.means
        self.coarsest = max(k for k, size in enumerate(self.sizes) if min(size) >= PATCH or k == 0)

    def patches(self, level: int) -> int:
        """Return the number of patches of a level."""
        across, down = (-(-(n - PATCH) // PATCH_STRIDE) + 1 for n in self.sizes[level])
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
        layout, grid = self._layout, self.grid
        check_image_size(image, grid.camera)
        staged = torch.empty(image.shape, dtype=torch.uint8, pin_memory=self.device.type == "cuda")
        staged.numpy()[...] = image
        rgb = staged.to(self.device, non_blocking=True)
        data = torch.empty(layout.total, device=self.device)
        textured = torch.empty(1, dtype=torch.int32, device=self.device)
        w, h = layout.width, layout.height
        self._kernels["flow_grey"](_tiles(w, h), (TILE, 8), rgb, data, textured, w, h, LEVELS)
        self._kernels["flow_structure"](
            -(-(grid.size + layout.means) // 8), (32, 8), data, textured, w, h,
            grid.width, grid.height, layout.pyramid, MIN_STRUCTURE,
        )  # fmt: skip
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
        layout, grid, pairs = self._layout, self.grid, len(images) // 2
        w, h = layout.width, layout.height
        pointers = torch.tensor([image.data.data_ptr() for image in images])
        table = to_device(pointers, self.device)
        forward, backward = (None, None) if start is None else start
        warped = self._warped(table, forward, backward)
        flow = self._coarse_to_fine(table, warped, start is None, finest)
        width, height = layout.sizes[finest]
        found = torch.empty(2 * pairs, height, width, device=self.device)
        self._kernels["flow_found"](
            (-(-width // 32), -(-height // 8), 2 * pairs), (32, 8), warped, flow, found,
            layout.pyramid, w, h, finest,
        )  # fmt: skip
        pixels = torch.empty(2, pairs, grid.size, 2, device=self.device)
        weight = torch.empty_like(pixels)
        scale = COARSE_DEVIATION if finest else 1.0
        self._kernels["flow_match"](
            (-(-grid.size // 8), 2 * pairs), (32, 8), table, flow, forward, backward, found,
            pixels, weight, pairs, w, h, grid.width, grid.height, finest, SHARP, UNINFORMED,
            MAX_DISAGREEMENT, *(scale * d for d in DEVIATION),
        )  # fmt: skip
        return pixels, weight

    def _warped(
        self,
        table: Int[Tensor, "d"],
        forward: Float[Tensor, "e p 2"] | None,
        backward: Float[Tensor, "e p 2"] | None,
    ) -> Float[Tensor, "d n"]:
        """Return pyramids of the second images, warped and with the first images' brightness."""
        layout, grid, directed = self._layout, self.grid, len(table)
        w, h, stride = layout.width, layout.height, layout.pyramid
        warped = torch.empty(directed, stride, device=self.device)
        gain = torch.empty(directed, layout.means, device=self.device)
        self._kernels["flow_warp"](
            (*_tiles(w, h), directed), (TILE, 8), table, forward, backward, warped,
            directed // 2, stride, w, h, grid.width, grid.height, LEVELS,
        )  # fmt: skip
        self._kernels["flow_gain"](
            (-(-layout.means // 8), directed), (32, 8), table, warped, gain, stride, w, h,
            layout.pyramid,
        )  # fmt: skip
        self._kernels["flow_brighten"](
            (-(-stride // 256), directed), 256, warped, gain, stride, w, h, LEVELS
        )
        return warped

    def _coarse_to_fine(
        self, table: Int[Tensor, "d"], warped: Float[Tensor, "d n"], cold: bool, finest: int
    ) -> Float[Tensor, "d q 2"]:
        """Compute dense flow at level ``finest``, row by row, in its pixels."""
        layout, directed = self._layout, len(table)
        w, h, stride = layout.width, layout.height, layout.pyramid
        coarsest = layout.coarsest if cold else min(WARM_LEVELS - 1, layout.coarsest)
        flow: Tensor | None = None
        for level in range(coarsest, finest - 1, -1):
            width, height = layout.sizes[level]
            count = layout.patches(level)
            patches: Tensor | None = None
            for reach in (0, *(COLD_REACHES if cold else ())):
                found = torch.empty(directed, count, 2, device=self.device)
                self._kernels["flow_search"](
                    (-(-count * PATCH // 256), directed), 256, table, warped, flow, patches, found,
                    stride, w, h, level, reach, ITERATIONS,
                )  # fmt: skip
                patches = found
            flow = torch.empty(directed, width * height, 2, device=self.device)
            other = torch.empty_like(flow)
            self._kernels["flow_densify"](
                (-(-width // 32), -(-height // 8), directed), (32, 8), table, warped, patches,
                flow, stride, w, h, level,
            )  # fmt: skip
            last = level == finest
            sweeps = SWEEPS if last else COARSE_SWEEPS
            for _ in range(REFINEMENTS if last else COARSE_REFINEMENTS):
                self._refine(table, warped, flow, other, level, sweeps)
                flow, other = other, flow
        assert flow is not None
        return flow

    def _refine(
        self, table: Tensor, warped: Tensor, flow: Tensor, refined: Tensor, level: int, sweeps: int
    ) -> None:
        layout = self._layout
        width, height = layout.sizes[level]
        blocks = (-(-width // REFINE_INNER), -(-height // REFINE_INNER), len(table))
        self._kernels["flow_refine"](
            blocks, (32, 8), table, warped, flow, refined, layout.pyramid, layout.width,
            layout.height, level, sweeps, SMOOTHNESS, GRADIENTS, BRIGHTNESS,
            ZETA**2, EPSILON**2, RELAXATION,
        )  # fmt: skip


def _tiles(width: int, height: int) -> tuple[int, int]:
    return -(-width // TILE), -(-height // TILE)
