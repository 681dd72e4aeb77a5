"""Bundle adjustment of many keyframes on the GPU: a few edges there at a time, poses on the CPU.

The dense solver (:mod:`geogs.bundle.cuda.dense`) keeps all linearised edges, and a camera system
whose memory grows with the square of the keyframes. Here edges are linearised chunk by chunk by
the same kernels, their blocks summed, and not kept; the camera system is sparse and solved by the
CPU. Once the poses' steps are known, edges are linearised a second time for the depths.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.cuda.depth_terms import KernelDepthTerms
from geogs.bundle.cuda.linear_edges import EdgeArrays, LinearisedEdges, edge_costs, joined_edges
from geogs.bundle.dense import FLOOR
from geogs.bundle.problem import StreamedProblem, source_chunks
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.schur import SchurBundle
from geogs.bundle.terms import BundleState
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device, upload_indices
from geogs.world.grid import SampleGrid

EDGES_TOGETHER = 1024
"""Directed edges linearised at a time; bounds memory (100 MB at 64 x 36 cells)."""


@dataclass(frozen=True)
class _Chunk:
    """Some sources with all their edges; frames are renumbered, sources first."""

    edges: slice
    sources: Tensor
    """Indices of the sources among all frames, on the CPU."""
    frames: Tensor
    """Sources, then the other frames of their edges."""
    arrays: EdgeArrays
    """Edges between frames by their new numbers."""
    added: Tensor
    """Blocks of the elimination that are added to the camera system untransposed."""
    added_to: Tensor
    """Blocks of the camera system to which these are added."""
    mirrored: Tensor
    mirrored_to: Tensor
    """The same for blocks that are transposed first."""
    pulled: Tensor
    pulled_to: Tensor
    """Vectors of the elimination, and poses to whose right-hand side they are added."""


class CudaStreamedBundle:
    """Solver for one grid on its GPU, with the interface of ``StreamedBundle``.

    Only inverse depths, matches and terms of depths are on the device.
    """

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid
        source = Path(__file__).with_name("linearise.cu")
        self.kernels = kernels_for(source, torch.device(grid.device))

    def solve(self, problem: StreamedProblem, options: BundleOptions) -> BundleResult:
        return _CudaStreamedSchur(problem, self, options).adjusted()


class _CudaStreamedSchur(SchurBundle[StreamedProblem, SparseCameraSystem]):
    """One adjustment that only keeps the camera system of linearised edges."""

    def __init__(
        self, problem: StreamedProblem, bundle: CudaStreamedBundle, options: BundleOptions
    ) -> None:
        super().__init__(problem, options)
        self.grid = bundle.grid
        self.kernels = bundle.kernels
        self.depth_terms = KernelDepthTerms.of(problem.depth_terms)
        self.system = SparseCameraSystem(*problem.joined(), problem.free_pose)
        device = problem.inverse_depth.device
        edges = source_chunks(problem.source, EDGES_TOGETHER)
        self.chunks = [_chunk(problem, part, self.system, device) for part in edges]

    def linearise(self, state: BundleState) -> SparseCameraSystem:
        """Linearise chunk by chunk."""
        T = state.T_cw
        d = state.inverse_depth
        system = self.system
        system.clear()
        blocks = d.new_zeros(system.size, 36, dtype=torch.float64)
        pull = d.new_zeros(len(T), 6, dtype=torch.float64)
        for chunk in self.chunks:
            edges = self._linearise(state, chunk)
            pairs = len(chunk.arrays.pair_a)
            found = blocks.new_empty(4 * pairs, 6, 6)
            vectors = blocks.new_empty(2 * pairs, 6)
            edges.eliminate(found, vectors)
            blocks.index_add_(0, chunk.added_to, found[chunk.added].flatten(1))
            blocks.index_add_(0, chunk.mirrored_to, found[chunk.mirrored].mT.flatten(1))
            pull.index_add_(0, chunk.pulled_to, vectors[chunk.pulled])
            self.information[chunk.sources.to(d.device)] = edges.information
        system.add_sums(blocks.cpu().reshape(-1, 6, 6), pull.cpu())
        for term in self.problem.pose_terms:
            system.add(term.hyper_edges(state))
        return system

    def flow_cost(self, state: BundleState) -> float:
        """Compute the cost chunk by chunk."""
        d = state.inverse_depth
        cost = state.inverse_depth.new_zeros(1, dtype=torch.float64)
        for chunk in self.chunks:
            depth = d[chunk.sources.to(d.device)]
            cost += edge_costs(
                self.kernels,
                chunk.arrays,
                self.grid,
                self._poses(state, chunk),
                depth,
                self._matches(chunk),
                self.options.huber,
            ).sum()
        return float(cost)

    def solve_cameras(self, linear: SparseCameraSystem, damping: float) -> Tensor | None:
        """Solve on the CPU."""
        return linear.solve(damping, FLOOR)

    def depth_steps(
        self, state: BundleState, linear: SparseCameraSystem, step: Float[Tensor, "v"]
    ) -> Float[Tensor, "n p"]:
        """Compute the depth steps from edges linearised a second time."""
        d = state.inverse_depth
        xi = step.reshape(-1, 6)
        delta = torch.zeros_like(d)
        failed = torch.zeros(1, dtype=torch.int32, device=d.device)
        for chunk in self.chunks:
            steps = d.new_zeros(len(chunk.sources), d.shape[1])
            moved = to_device(xi[chunk.frames].reshape(-1), d.device)
            self._linearise(state, chunk).find_depth_steps(moved, steps, failed)
            delta[chunk.sources.to(d.device)] = steps
        return delta

    def _linearise(self, state: BundleState, chunk: _Chunk) -> LinearisedEdges:
        own = chunk.sources.to(state.inverse_depth.device)
        depth = state.inverse_depth[own]
        edges = LinearisedEdges(self.kernels, chunk.arrays, depth)
        edges.fill(
            self.grid,
            self._poses(state, chunk),
            depth,
            self._matches(chunk),
            self.options,
            self.depth_terms.of_rows(own),
        )
        return edges

    def _poses(self, state: BundleState, chunk: _Chunk) -> Float[Tensor, "m"]:
        """Return poses of a chunk's frames on the device."""
        return to_device(state.T_cw[chunk.frames].reshape(-1), state.inverse_depth.device)

    def _matches(self, chunk: _Chunk) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
        pixels, weight = self.problem.matches(chunk.edges)
        return pixels.contiguous(), weight.contiguous()


def _chunk(
    problem: StreamedProblem, edges: slice, system: SparseCameraSystem, device: torch.device
) -> _Chunk:
    """Build a chunk's index arrays, copied to the device at once."""
    source = problem.source[edges].numpy()
    target = problem.target[edges].numpy()
    own = np.unique(source)
    frames = np.concatenate([own, np.setdiff1d(target, own)])
    number = np.empty(len(problem.T_cw), np.int64)
    number[frames] = np.arange(len(frames))
    first = np.searchsorted(source, np.append(own, own[-1] + 1))
    free = problem.free_depth.numpy()[own]
    a, b = joined_edges(first, free)
    row = np.stack([target[a], target[a], source[a], source[a]], 1).reshape(-1)
    column = np.stack([target[b], source[a], target[b], source[a]], 1).reshape(-1)
    place = system.block_indices(row, column)
    mirror = system.block_indices(column, row)
    mirror[np.repeat(a == b, 4)] = -1  # the elimination gives both sides
    added = np.flatnonzero(place >= 0)
    mirrored = np.flatnonzero(mirror >= 0)
    same = np.flatnonzero(a == b)
    pulled = np.concatenate([2 * same, 2 * same + 1])
    pulled_to = np.concatenate([target[a[same]], source[a[same]]])
    parts = [number[source], number[target], first, free, a, b, added, place[added], mirrored,
             mirror[mirrored], pulled, pulled_to]  # fmt: skip
    pieces = upload_indices(parts, device)
    return _Chunk(
        edges, torch.from_numpy(own), torch.from_numpy(frames), EdgeArrays(*pieces[:6]), *pieces[6:]
    )
