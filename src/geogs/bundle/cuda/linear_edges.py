"""Edges on the GPU: index arrays, and their linearisation by kernels.

The dense and the streamed solver share these launches.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.cuda.depth_terms import KernelDepthTerms
from geogs.bundle.flow_term import BEHIND
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import MEASURED_HUBER
from geogs.gpu.kernels import Kernel
from geogs.gpu.transfer import to_device
from geogs.world.grid import SampleGrid

LAUNCH_BOUND = 512
"""Most threads of a block of the kernels that adjust poses, or depths at given poses."""


def block_size(cells: int, most: int = 256) -> int:
    """Return the threads of a block over an edge's cells: whole warps, 64 to ``most``."""
    return max(64, min(-(-cells // 32) * 32, most))


def edges_by_frame(
    frame: Int[Tensor, "e"], frames: int, device: torch.device
) -> tuple[Int[Tensor, "m"], Int[Tensor, "e"]]:
    """Sort edges by frame; return the start of each frame's edges, plus the end, and the order."""
    order = torch.argsort(frame, stable=True)
    first = torch.searchsorted(frame[order], torch.arange(frames + 1))
    rows = to_device(torch.cat([first, order]), device, torch.int32)
    return rows[: frames + 1], rows[frames + 1 :]


def joined_edges(
    first: Int[np.ndarray, "m"], free_depth: Bool[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Return pairs a <= b of edges of one source; only a = b where its depth is fixed."""
    pairs = [np.zeros((2, 0), dtype=np.int64)]
    for begin, end, joined in zip(first[:-1], first[1:], free_depth, strict=True):
        count = end - begin
        low = np.tril_indices(count) if joined else (np.arange(count), np.arange(count))
        pairs.append(begin + np.stack(low))
    b, a = np.concatenate(pairs, 1)
    return a, b


@dataclass(frozen=True)
class EdgeArrays:
    """Index arrays of edges, int32 on the device.

    Frames are renumbered, sources first.
    """

    source: Tensor
    target: Tensor
    first: Tensor
    """First edge of each source, and the end."""
    free_depth: Tensor
    """Whether each source's depth is free."""
    pair_a: Tensor
    """Pairs a <= b of edges of one source, joined by the elimination."""
    pair_b: Tensor


def edge_costs(
    kernels: Mapping[str, Kernel],
    arrays: EdgeArrays,
    grid: SampleGrid,
    poses: Float[Tensor, "m"],
    depth: Float[Tensor, "s p"],
    matches: tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]],
    huber: float,
) -> Float[Tensor, "e"]:
    """Compute Huber's cost of the matched cells of each edge, float64: ``FlowTerm.cost``."""
    a = arrays
    c = grid.camera
    cells = depth.shape[1]
    cost = depth.new_empty(len(a.source), dtype=torch.float64)
    kernels["find_edge_costs"](
        len(a.source), block_size(cells), poses, depth, a.source, a.target, *matches, grid.rays,
        cells, *c.numbers, huber, BEHIND, cost,
    )  # fmt: skip
    return cost


class LinearisedEdges:
    """Linearised edges and their sources, on the device."""

    def __init__(
        self, kernels: Mapping[str, Kernel], arrays: EdgeArrays, depth: Float[Tensor, "s p"]
    ) -> None:
        """``depth`` has the shape of the sources' inverse depths."""
        edges = len(arrays.source)
        cells = depth.shape[1]
        self.kernels = kernels
        self.arrays = arrays
        self.block = block_size(cells)
        self.motion = depth.new_empty(12 * edges, dtype=torch.float64)
        self.normal = depth.new_empty(32 * edges, dtype=torch.float64)
        self.coupling = depth.new_empty(6 * edges * cells)
        self.per_edge = depth.new_empty(2, edges * cells)
        """Curvature and gradient of the depths of each edge's source, by that edge alone."""
        self.information = torch.zeros_like(depth)
        self.depths = depth.new_empty(2, depth.numel())
        """Inverse damped curvature and gradient of all depths."""

    @property
    def cells(self) -> int:
        """Cells of a source."""
        return self.information.shape[1]

    def fill(
        self,
        grid: SampleGrid,
        poses: Float[Tensor, "m"],
        depth: Float[Tensor, "s p"],
        matches: tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]],
        options: BundleOptions,
        terms: KernelDepthTerms,
    ) -> None:
        """Linearise all edges; sum the equations of each source's depths, with all terms."""
        a = self.arrays
        c = grid.camera
        (curvature, gradient) = self.per_edge
        self.kernels["linearise_edges"](
            len(a.source), self.block, poses, depth, a.source, a.target, *matches, grid.rays,
            self.cells, *c.numbers, options.huber, self.motion, self.normal,
            self.coupling, curvature, gradient,
        )  # fmt: skip
        self.kernels["sum_sources"](
            len(depth), self.block, a.first, curvature, gradient, self.cells,
            options.depth_damping, terms.damping, depth, terms.measured, terms.information,
            MEASURED_HUBER, self.information, *self.depths,
        )  # fmt: skip

    def eliminate(self, blocks: Tensor, vectors: Tensor) -> None:
        """Eliminate depths: four blocks and two vectors of poses for each pair of edges."""
        a = self.arrays
        self.kernels["eliminate_depths"](
            len(a.pair_a), self.block, a.pair_a, a.pair_b, a.source, a.free_depth, self.coupling,
            *self.depths, self.motion, self.normal, self.cells, blocks, vectors,
        )  # fmt: skip

    def find_depth_steps(self, xi: Tensor, steps: Tensor, failed: Tensor) -> None:
        """Compute steps of the sources' depths after those of all poses."""
        a = self.arrays
        self.kernels["find_depth_steps"](
            (-(-self.cells // self.block), len(a.free_depth)), self.block, a.first, a.target,
            a.free_depth, self.motion, xi, self.coupling, *self.depths, self.cells, steps, failed,
        )  # fmt: skip
