"""Dense bundle adjustment on the GPU: a handful of launches per step, one wait per solve."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from geogs.bundle.base import BundleOptions, BundleResult
from geogs.bundle.cuda.depth_terms import KernelDepthTerms
from geogs.bundle.problem import BundleProblem
from geogs.bundle.terms import BundleState
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.world.grid import SampleGrid

MAX_FEW = 16
"""Free poses up to which one block solves the camera system; ``MAX_POSES`` of the source."""
PANEL = 48
"""Columns of a larger system that are factored at a time; ``PANEL`` of the source."""
TILE = 32
"""Rows and columns of the tiles of a larger system; ``TILE`` of the source."""


def block_size(cells: int, most: int = 256) -> int:
    """Threads of a block that goes over the cells of an edge: whole warps, 64 to ``most``."""
    return max(64, min(-(-cells // 32) * 32, most))


def edges_by_frame(
    frame: Int[Tensor, "e"], frames: int, device: torch.device
) -> tuple[Int[Tensor, "m"], Int[Tensor, "e"]]:
    """Where the edges of each frame begin, and the end, in a list of all edges; and that list."""
    order = torch.argsort(frame, stable=True)
    first = torch.searchsorted(frame[order], torch.arange(frames + 1))
    rows = to_device(torch.cat([first, order]), device, torch.int32)
    return rows[: frames + 1], rows[frames + 1 :]


@dataclass(frozen=True)
class _Structure:
    """Which frames and edges there are and how they meet, as index arrays on the device."""

    poses: int
    """Number of free poses."""
    source: Tensor
    target: Tensor
    first: Tensor
    """First edge of each frame, and the end."""
    slot: Tensor
    """Place of each frame in the camera system, -1 where its pose is fixed."""
    free_depth: Tensor
    pair_a: Tensor
    """Pairs a <= b of edges of one source that the elimination joins."""
    pair_b: Tensor
    places: Tensor
    """Blocks of the camera system, see ``assemble_system``."""
    first_part: Tensor
    parts: Tensor

    @property
    def frames(self) -> int:
        return len(self.slot)

    @property
    def edges(self) -> int:
        return len(self.source)


def _structure(problem: BundleProblem, device: torch.device) -> _Structure:
    """The index arrays, sent to the device in one piece."""
    source, target, free_pose, free_depth = (
        x.cpu().numpy()
        for x in (problem.source, problem.target, problem.free_pose, problem.free_depth)
    )
    first = np.searchsorted(source, np.arange(len(free_pose) + 1))
    a, b = joined_edges(first, free_depth)
    slot = np.where(free_pose, np.cumsum(free_pose) - 1, -1)
    poses = int(free_pose.sum())
    system = _system_parts(slot[source[a]], slot[target[a]], slot[target[b]], a == b, poses)
    parts = [source, target, first, slot, free_depth, a, b, *system]
    sent = to_device(torch.from_numpy(np.concatenate(parts).astype(np.int32)), device)
    return _Structure(poses, *sent.split([len(p) for p in parts]))


def joined_edges(
    first: Int[np.ndarray, "m"], free_depth: Bool[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Pairs a <= b of edges of one source; only a = b where its depth is fixed."""
    pairs = [np.zeros((2, 0), dtype=np.int64)]
    for begin, end, joined in zip(first[:-1], first[1:], free_depth, strict=True):
        count = end - begin
        low = np.tril_indices(count) if joined else (np.arange(count), np.arange(count))
        pairs.append(begin + np.stack(low))
    b, a = np.concatenate(pairs, 1)
    return a, b


def _system_parts(
    source: Int[np.ndarray, "k"],
    target_a: Int[np.ndarray, "k"],
    target_b: Int[np.ndarray, "k"],
    same: Bool[np.ndarray, "k"],
    poses: int,
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m1"], Int[np.ndarray, "l"]]:
    """What each block of the camera system is the sum of: places, first parts, parts.

    Given are the slots of the frames of every pair of edges. A pair of two edges stands for its
    mirror image as well.
    """
    row = np.concatenate([target_a, target_a, source, source])
    column = np.concatenate([target_b, source, target_b, source])
    pair = np.arange(len(same))
    block = np.concatenate([4 * pair + k for k in range(4)])
    both = np.tile(~same, 4)
    row, column = np.concatenate([row, column[both]]), np.concatenate([column, row[both]])
    part = np.concatenate([2 * block, 2 * block[both] + 1])
    lower = (row >= column) & (column >= 0)
    right = np.concatenate([target_a[same], source[same]])
    vector = np.concatenate([2 * pair[same], 2 * pair[same] + 1])[right >= 0]
    right = right[right >= 0]
    found = np.concatenate([row[lower] * (poses + 1) + column[lower], right * (poses + 1) + poses])
    part = np.concatenate([part[lower], vector])
    order = np.argsort(found, kind="stable")
    # Every place is listed, so that those without parts are set to zero.
    p, q = np.tril_indices(poses)
    places = np.concatenate([p * (poses + 1) + q, np.arange(poses) * (poses + 1) + poses])
    places.sort()
    first = np.searchsorted(found[order], np.append(places, (poses + 1) ** 2))
    return places, first, part[order]


class _Workspace:
    """What one solve keeps on the device, the state that is adjusted among it."""

    def __init__(self, problem: BundleProblem, structure: _Structure, device: torch.device) -> None:
        d = problem.inverse_depth
        self.structure = s = structure
        edges, cells = s.edges, d.shape[1]
        self.cells = cells
        # Poses and the sign of failure travel back together.
        self.memory = torch.zeros(16 * s.frames + 1, dtype=torch.float64, device=device)
        self.memory[: 16 * s.frames].copy_(to_device(problem.T_cw.reshape(-1), device))
        self.T = self.memory[: 16 * s.frames]
        self.failed = self.memory[16 * s.frames :].view(torch.int32)
        self.inverse_depth = d.clone()
        size = 6 * s.poses
        self.system = self.memory.new_empty((size + 1) * size)
        self.panels = -(-size // PANEL)
        self.inverses = self.memory.new_empty(self.panels * PANEL * PANEL)
        self.good = torch.empty(1, dtype=torch.int32, device=device)
        self.xi = self.memory.new_zeros(6 * s.frames)
        self.blocks = self.memory.new_empty(144 * len(s.pair_a))
        self.vectors = self.memory.new_empty(12 * len(s.pair_a))
        self.motion = self.memory.new_empty(12 * edges)
        self.normal = self.memory.new_empty(32 * edges)
        self.coupling = d.new_empty(6 * edges * cells)
        self.curvature, self.gradient = d.new_empty(2, edges * cells).unbind()
        self.information = torch.zeros_like(d)
        self.inverse_curvature, self.depth_gradient, self.delta = d.new_empty(3, d.numel()).unbind()
        self.residual = d.new_zeros(edges)
        self.depth_terms, self.block = KernelDepthTerms.of(problem.depth_terms), problem.block

    @property
    def state(self) -> BundleState:
        """What is adjusted, where it is."""
        return BundleState(self.T.reshape(-1, 4, 4), self.inverse_depth, self.block)


def _add_pose_terms(w: _Workspace, problem: BundleProblem, damping: float) -> None:
    """Add what is said of poses alone to the assembled camera system, which waits for them."""
    if not problem.pose_terms:
        return
    n = w.structure.poses
    size = 6 * n
    slot = torch.full((len(problem.free_pose),), -1)
    slot[problem.free_pose.cpu()] = torch.arange(n)
    state = BundleState(w.T.reshape(-1, 4, 4).cpu(), problem.inverse_depth)
    added = torch.zeros(size + 1, size, dtype=torch.float64)
    for edge in (edge for term in problem.pose_terms for edge in term.hyper_edges(state)):
        block, gradient = edge.pose_blocks()
        at = slot[edge.poses].tolist()
        for a, p in enumerate(at):
            if p < 0:
                continue
            added[size, 6 * p : 6 * p + 6] += gradient[a]
            for b, q in enumerate(at):
                if 0 <= q <= p:
                    added[6 * p : 6 * p + 6, 6 * q : 6 * q + 6] += block[a, b]
    diagonal = added[:size].diagonal()
    diagonal += damping * diagonal.abs()
    w.system += to_device(added.reshape(-1), w.system.device)


class CudaDenseBundle:
    """Solver for one grid on its GPU, with the interface of ``DenseBundle``.

    Only the inverse depths, pixels and weights of a problem need to be on the device; with the rest
    on the CPU nothing waits until the result is fetched.
    """

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid
        device = torch.device(grid.device)
        self.kernels = kernels_for(Path(__file__).with_name("linearise.cu"), device)
        self.solvers = kernels_for(Path(__file__).with_name("solve.cu"), device)
        self._last: tuple[tuple[bytes, ...], _Structure] | None = None

    def solve(self, problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
        """As in the protocol; poses are returned where they were given.

        Whether a step is small nobody waits for, so that ``tolerance`` plays no part.
        """
        options = options or BundleOptions()
        device = problem.inverse_depth.device
        w = _Workspace(problem, self._structure_of(problem, device), device)
        steps = _Steps(self, problem, options)
        policy = Policy(options.iterations, options.damping)
        minimise(w, steps.linearise, steps.step, policy)
        memory = w.memory.cpu()
        T = memory[:-1].reshape(-1, 4, 4).to(problem.T_cw.device)
        finite = int(memory[-1:].view(torch.int32)[0]) == 0
        return BundleResult(T, w.inverse_depth, w.information, w.residual, finite)

    def _structure_of(self, problem: BundleProblem, device: torch.device) -> _Structure:
        """That of the last problem, if it is the same: edges are adjusted in rounds."""
        parts = (problem.source, problem.target, problem.free_pose, problem.free_depth)
        key = tuple(x.cpu().numpy().tobytes() for x in parts)
        if self._last is None or self._last[0] != key:
            self._last = key, _structure(problem, device)
        return self._last[1]


class _Steps:
    """One adjustment as the least-squares loop sees it; the workspace is changed in place."""

    def __init__(
        self, bundle: CudaDenseBundle, problem: BundleProblem, options: BundleOptions
    ) -> None:
        self.grid, self.problem, self.options = bundle.grid, problem, options
        self.kernels, self.solvers = bundle.kernels, bundle.solvers
        self.matches = problem.pixels.contiguous(), problem.weight.contiguous()

    def linearise(self, state: _Workspace) -> None:
        """Edges, summed up by source."""
        w, s, c, options = state, state.structure, self.grid.camera, self.options
        block = block_size(w.cells)
        self.kernels["linearise_edges"](
            s.edges, block, w.T, w.inverse_depth, s.source, s.target, *self.matches,
            self.grid.rays, w.cells, c.fx, c.fy, c.cx, c.cy, options.huber, w.motion, w.normal,
            w.coupling, w.curvature, w.gradient, w.residual,
        )  # fmt: skip
        damping, *measured = w.depth_terms.arguments()
        self.kernels["sum_sources"](
            s.frames, block, s.first, w.curvature, w.gradient, w.cells, options.depth_damping,
            damping, w.inverse_depth, *measured, w.information, w.inverse_curvature,
            w.depth_gradient,
        )  # fmt: skip
        w.depth_terms.add_others(
            range(s.frames), w.state, w.information, w.inverse_curvature, w.depth_gradient
        )

    def step(self, state: _Workspace, linear: None, damping: float) -> Step[_Workspace]:
        """All moves on the device, which keeps in mind whether one was not finite."""
        self._solve_cameras(state, damping)
        self._move(state)
        return Step(state)

    def _solve_cameras(self, w: _Workspace, damping: float) -> None:
        s = w.structure
        if not s.poses:
            return
        self.kernels["eliminate_depths"](
            len(s.pair_a), block_size(w.cells), s.pair_a, s.pair_b, s.source, s.free_depth,
            w.coupling, w.inverse_curvature, w.depth_gradient, w.motion, w.normal, w.cells,
            w.blocks, w.vectors,
        )  # fmt: skip
        self.kernels["assemble_system"](
            len(s.places), 256, s.places, s.first_part, s.parts, w.blocks, w.vectors, s.poses,
            damping, w.system,
        )  # fmt: skip
        _add_pose_terms(w, self.problem, damping)
        if s.poses <= MAX_FEW:
            threads = min(256, 32 * s.poses)
            self.solvers["solve_few_poses"](1, threads, w.system, s.slot, s.poses, s.frames, w.xi)
        else:
            self._solve_many_poses(w)

    def _solve_many_poses(self, w: _Workspace) -> None:
        """Cholesky's method panel by panel."""
        s, size = w.structure, 6 * w.structure.poses
        for k in range(0, size, PANEL):
            self.solvers["factor_panel"](1, 256, w.system, size, k, w.inverses, w.good)
            # The right-hand side is a row below every panel.
            tiles = -(-(size + 1 - min(k + PANEL, size)) // TILE)
            self.solvers["substitute_panel"](tiles, 256, w.system, size, k, w.inverses)
            if k + PANEL < size:
                self.solvers["update_rest"]((tiles, tiles), 256, w.system, size, k)
        threads = min(1024, 32 * s.poses)
        self.solvers["substitute_back"](
            1, threads, w.system, size, w.inverses, w.good, s.slot, s.frames, w.xi
        )

    def _move(self, w: _Workspace) -> None:
        s, options, block = w.structure, self.options, block_size(w.cells)
        grid = (-(-w.cells // block), s.frames)
        self.kernels["find_depth_steps"](
            grid, block, s.first, s.target, s.free_depth, w.motion, w.xi, w.coupling,
            w.inverse_curvature, w.depth_gradient, w.cells, w.delta, w.failed,
        )  # fmt: skip
        self.kernels["take_steps"](
            grid, block, s.slot, s.free_depth, w.xi, w.delta, w.cells, options.min_inverse_depth,
            options.max_inverse_depth, w.failed, w.T, w.inverse_depth,
        )  # fmt: skip
