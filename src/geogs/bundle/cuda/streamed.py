"""Bundle adjustment of many keyframes on the GPU: a few edges there at a time, poses on the CPU.

The dense solver (:mod:`geogs.bundle.cuda.dense`) keeps all that is linearised, and a camera system
whose memory grows with the square of the keyframes. Here edges are linearised chunk by chunk by
the same kernels, their blocks added up, and forgotten; the camera system is sparse and solved by
the CPU. Once the poses' steps are known, edges are linearised a second time for the depths.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.base import BundleOptions, BundleResult
from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.cuda.dense import block_size, joined_edges
from geogs.bundle.dense import stepped
from geogs.bundle.linearise import motion_stars
from geogs.bundle.problem import MEASURED_HUBER, StreamedProblem, known_before, source_chunks
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.world.grid import SampleGrid

EDGES_TOGETHER = 1024
"""Directed edges that are linearised at a time; bounds memory (100 MB at 64 x 36 cells)."""


@dataclass(frozen=True)
class _Chunk:
    """Some sources with all their edges; frames are numbered anew, sources first."""

    edges: slice
    sources: Tensor
    """Of all frames, on the CPU."""
    frames: Tensor
    """Sources, then the other frames that their edges reach."""
    source: Tensor
    target: Tensor
    """Of each edge, by the new numbers, int32 on the device; so are all that follow."""
    first: Tensor
    """First edge of each source, and the end."""
    free_depth: Tensor
    pair_a: Tensor
    pair_b: Tensor
    added: Tensor
    """Blocks of the elimination that are added to the camera system as they are..."""
    added_to: Tensor
    """... and to which of its blocks."""
    turned: Tensor
    turned_to: Tensor
    """Likewise of those that are transposed first."""
    pulled: Tensor
    pulled_to: Tensor
    """Vectors of the elimination, and to the right-hand side of which pose they are added."""


class _Linearised:
    """What the kernels leave of a chunk."""

    def __init__(self, chunk: _Chunk, inverse_depth: Float[Tensor, "s p"]) -> None:
        d, edges, cells = inverse_depth, len(chunk.source), inverse_depth.shape[1]
        self.motion = d.new_empty(12 * edges, dtype=torch.float64)
        self.normal = d.new_empty(32 * edges, dtype=torch.float64)
        self.coupling = d.new_empty(6 * edges * cells)
        self.curvature, self.gradient = d.new_empty(2, edges * cells).unbind()
        self.residual = d.new_zeros(edges)
        self.information = torch.zeros_like(d)
        self.inverse_curvature, self.depth_gradient = d.new_empty(2, d.numel()).unbind()


class CudaStreamedBundle:
    """Solver for one grid on its GPU, with the interface of ``StreamedBundle``."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid
        source = Path(__file__).with_name("linearise.cu")
        self._step = kernels_for(source, torch.device(grid.device))

    def solve(self, problem: StreamedProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` damped Gauss-Newton steps, as the dense solver does.

        Only inverse depths, matches and what belongs to them are on the device. A step that is not
        finite is not taken, and ``finite`` is False in the result.
        """
        options = options or BundleOptions()
        T, d = problem.T_cw, problem.inverse_depth
        information, residual = known_before(problem), d.new_zeros(len(problem.source))
        system = SparseCameraSystem(*problem.joined(), problem.free_pose)
        edges = source_chunks(problem.source, EDGES_TOGETHER)
        chunks = [_chunk(problem, part, system, d.device) for part in edges]
        finite = True
        for _ in range(options.iterations):
            system.clear()
            blocks = d.new_zeros(system.size, 36, dtype=torch.float64)
            pull = d.new_zeros(len(T), 6, dtype=torch.float64)
            for chunk in chunks:
                linear = self._linearise(problem, chunk, T, d, options)
                self._eliminate(chunk, linear, d.shape[1], blocks, pull)
                information[chunk.sources.to(d.device)] = linear.information
                residual[chunk.edges] = linear.residual
            system.add_sums(blocks.cpu().reshape(-1, 6, 6), pull.cpu())
            system.add(motion_stars(problem.motions, T))
            xi = system.solve(options.damping)
            delta = self._depth_steps(problem, chunks, T, d, xi, options)
            if not bool(torch.isfinite(xi).all() and torch.isfinite(delta).all()):
                finite = False
                break
            T, d = stepped(problem, T, d, xi, delta, options)
            if float(xi.abs().max()) < options.tolerance:
                break
        return BundleResult(T, d, information, residual, finite)

    def _linearise(
        self,
        problem: StreamedProblem,
        chunk: _Chunk,
        T: Float[Tensor, "n 4 4"],
        d: Float[Tensor, "n p"],
        options: BundleOptions,
    ) -> _Linearised:
        pixels, weight = (m.contiguous() for m in problem.matches(chunk.edges))
        own = chunk.sources.to(d.device)
        depth, c = d[own], self.grid.camera
        linear, cells = _Linearised(chunk, depth), d.shape[1]
        poses = to_device(T[chunk.frames].reshape(-1), d.device)
        self._step["linearise_edges"](
            len(chunk.source), block_size(cells), poses, depth, chunk.source, chunk.target, pixels,
            weight, self.grid.rays, cells, c.fx, c.fy, c.cx, c.cy, options.huber, linear.motion,
            linear.normal, linear.coupling, linear.curvature, linear.gradient, linear.residual,
        )  # fmt: skip
        damping = None if problem.damping is None else problem.damping[own]
        measured: tuple[Tensor | None, Tensor | None] = (None, None)
        if problem.measured is not None:
            measured = problem.measured.inverse_depth[own], problem.measured.information[own]
        self._step["sum_sources"](
            len(own), block_size(cells), chunk.first, linear.curvature, linear.gradient, cells,
            options.depth_damping, damping, depth, *measured, MEASURED_HUBER, linear.information,
            linear.inverse_curvature, linear.depth_gradient,
        )  # fmt: skip
        return linear

    def _eliminate(
        self,
        chunk: _Chunk,
        linear: _Linearised,
        cells: int,
        blocks: Float[Tensor, "m 36"],
        pull: Float[Tensor, "n 6"],
    ) -> None:
        """Add what a chunk says of the poses."""
        pairs = len(chunk.pair_a)
        found, vectors = blocks.new_empty(4 * pairs, 6, 6), blocks.new_empty(2 * pairs, 6)
        self._step["eliminate_depths"](
            pairs, block_size(cells), chunk.pair_a, chunk.pair_b, chunk.source, chunk.free_depth,
            linear.coupling, linear.inverse_curvature, linear.depth_gradient, linear.motion,
            linear.normal, cells, found, vectors,
        )  # fmt: skip
        blocks.index_add_(0, chunk.added_to, found[chunk.added].flatten(1))
        blocks.index_add_(0, chunk.turned_to, found[chunk.turned].mT.flatten(1))
        pull.index_add_(0, chunk.pulled_to, vectors[chunk.pulled])

    def _depth_steps(
        self,
        problem: StreamedProblem,
        chunks: Sequence[_Chunk],
        T: Float[Tensor, "n 4 4"],
        d: Float[Tensor, "n p"],
        xi: Float[Tensor, "n 6"],
        options: BundleOptions,
    ) -> Float[Tensor, "n p"]:
        delta, cells = torch.zeros_like(d), d.shape[1]
        failed = torch.zeros(1, dtype=torch.int32, device=d.device)
        block = block_size(cells)
        for chunk in chunks:
            linear = self._linearise(problem, chunk, T, d, options)
            sources = len(chunk.sources)
            steps = d.new_zeros(sources, cells)
            self._step["find_depth_steps"](
                (-(-cells // block), sources), block, chunk.first, chunk.target, chunk.free_depth,
                linear.motion, to_device(xi[chunk.frames].reshape(-1), d.device), linear.coupling,
                linear.inverse_curvature, linear.depth_gradient, cells, steps, failed,
            )  # fmt: skip
            delta[chunk.sources.to(d.device)] = steps
        return delta


def _chunk(
    problem: StreamedProblem, edges: slice, system: SparseCameraSystem, device: torch.device
) -> _Chunk:
    """A chunk's index arrays, sent to the device in one piece."""
    source, target = problem.source[edges].numpy(), problem.target[edges].numpy()
    own = np.unique(source)
    frames = np.concatenate([own, np.setdiff1d(target, own)])
    number = np.empty(len(problem.T_cw), np.int64)
    number[frames] = np.arange(len(frames))
    first = np.searchsorted(source, np.append(own, own[-1] + 1))
    free = problem.free_depth.numpy()[own]
    a, b = joined_edges(first, free)
    row = np.stack([target[a], target[a], source[a], source[a]], 1).reshape(-1)
    column = np.stack([target[b], source[a], target[b], source[a]], 1).reshape(-1)
    place, mirror = system.places(row, column), system.places(column, row)
    mirror[np.repeat(a == b, 4)] = -1  # the elimination gives both sides
    added, turned = np.flatnonzero(place >= 0), np.flatnonzero(mirror >= 0)
    same = np.flatnonzero(a == b)
    pulled = np.concatenate([2 * same, 2 * same + 1])
    pulled_to = np.concatenate([target[a[same]], source[a[same]]])
    parts = [number[source], number[target], first, free, a, b, added, place[added], turned,
             mirror[turned], pulled, pulled_to]  # fmt: skip
    sent = to_device(torch.from_numpy(np.concatenate(parts).astype(np.int32)), device)
    pieces = sent.split([len(p) for p in parts])
    return _Chunk(edges, torch.from_numpy(own), torch.from_numpy(frames), *pieces)
