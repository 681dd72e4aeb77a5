"""Dense bundle adjustment on the GPU: a handful of launches per step, one wait per solve."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.camera_system import DenseCameraSystem
from geogs.bundle.cuda.depth_terms import KernelDepthTerms
from geogs.bundle.cuda.linear_edges import EdgeArrays, LinearisedEdges, edge_costs, joined_edges
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import INVERSE_DEPTHS
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.terms import BundleState
from geogs.geometry.least_squares import Step, minimise
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device, upload_indices
from geogs.world.grid import SampleGrid
from geogs.world.lru import LruCache

MAX_FEW = 16
"""Free poses up to which one block solves the camera system; ``MAX_POSES`` of the source."""
PANEL = 48
"""Columns of a larger system that are factored at a time; ``PANEL`` of the source."""
TILE = 32
"""Rows and columns of the tiles of a larger system; ``TILE`` of the source."""


@dataclass(frozen=True)
class _Structure:
    """Structure of frames and edges, as index arrays on the device."""

    poses: int
    """Number of free poses."""
    edges: EdgeArrays
    """Edges; all frames may be sources."""
    slot: Tensor
    """Slot of each frame in the camera system, -1 where its pose is fixed."""
    places: Tensor
    """Blocks of the camera system, see ``assemble_system``."""
    first_part: Tensor
    parts: Tensor

    @property
    def frames(self) -> int:
        return len(self.slot)


def _structure(problem: BundleProblem, device: torch.device) -> _Structure:
    """Build the index arrays, copied to the device at once."""
    source, target, free_pose, free_depth = (
        x.cpu().numpy()
        for x in (problem.source, problem.target, problem.free_pose, problem.free_depth)
    )
    first = np.searchsorted(source, np.arange(len(free_pose) + 1))
    a, b = joined_edges(first, free_depth)
    slot = np.where(free_pose, np.cumsum(free_pose) - 1, -1)
    poses = int(free_pose.sum())
    system = _system_parts(slot[source[a]], slot[target[a]], slot[target[b]], a == b, poses)
    parts = [source, target, first, free_depth, a, b, slot, *system]
    pieces = upload_indices(parts, device)
    return _Structure(poses, EdgeArrays(*pieces[:6]), *pieces[6:])


def _system_parts(
    source: Int[np.ndarray, "k"],
    target_a: Int[np.ndarray, "k"],
    target_b: Int[np.ndarray, "k"],
    same: Bool[np.ndarray, "k"],
    poses: int,
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m1"], Int[np.ndarray, "l"]]:
    """Return the parts summed in each block of the camera system: places, first parts, parts.

    Arguments are the slots of the frames of every pair of edges. A pair of two edges represents its
    mirror image, too.
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
    # Every block is listed, so that those without parts are set to zero.
    p, q = np.tril_indices(poses)
    places = np.concatenate([p * (poses + 1) + q, np.arange(poses) * (poses + 1) + poses])
    places.sort()
    first = np.searchsorted(found[order], np.append(places, (poses + 1) ** 2))
    return places, first, part[order]


@dataclass(frozen=True)
class _State:
    """Unknowns on the device."""

    memory: Float[Tensor, "m"]
    """Poses and the failure flag, which are copied back together."""
    inverse_depth: Float[Tensor, "n p"]

    @staticmethod
    def at_start(problem: BundleProblem) -> "_State":
        """Return the initial state of the adjustment."""
        d = problem.inverse_depth
        T = problem.T_cw
        memory = torch.zeros(T.numel() + 1, dtype=torch.float64, device=d.device)
        memory[:-1].copy_(to_device(T.reshape(-1), d.device))
        return _State(memory, d)

    @property
    def T(self) -> Float[Tensor, "m"]:
        """Poses, flattened."""
        return self.memory[:-1]

    @property
    def failed(self) -> Int[Tensor, "2"]:
        """Failure flag: not zero once a step was not finite."""
        return self.memory[-1:].view(torch.int32)

    @property
    def everything(self) -> BundleState:
        """State for the terms."""
        return BundleState(self.T.reshape(-1, 4, 4), self.inverse_depth)

    @property
    def with_poses_here(self) -> BundleState:
        """State for pose terms, on the CPU; waits for the GPU."""
        return BundleState(self.T.reshape(-1, 4, 4).cpu(), self.inverse_depth)

    def copy(self) -> "_State":
        """Return a copy that a step may change."""
        return _State(self.memory.clone(), self.inverse_depth.clone())


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
        self._structures: LruCache[tuple[bytes, ...], _Structure] = LruCache(2)

    def solve(self, problem: BundleProblem, options: BundleOptions) -> BundleResult:
        """Take the steps; poses are returned on their original device.

        Where steps need not lower the cost, nothing waits for them, so neither small steps
        (``tolerance``) nor non-finite ones end the loop early.
        """
        steps = _DenseSteps(self, problem, options)
        cost = steps.cost if options.lowers_cost else None
        found = minimise(
            _State.at_start(problem), steps.linearise, steps.step, options.policy, cost
        )
        memory = found.state.memory.cpu()
        T = memory[:-1].reshape(-1, 4, 4).to(problem.T_cw.device)
        finite = found.finite and int(memory[-1:].view(torch.int32)[0]) == 0
        return BundleResult(T, found.state.inverse_depth, steps.edges.information, finite)

    def structure_of(self, problem: BundleProblem) -> _Structure:
        """Return the structure of a problem. The last two are cached: edges are adjusted in rounds,
        poses with depths and depths alone in turn."""
        parts = (problem.source, problem.target, problem.free_pose, problem.free_depth)
        key = tuple(x.cpu().numpy().tobytes() for x in parts)
        return self._structures.get(key, lambda: _structure(problem, problem.inverse_depth.device))


class _DenseSteps:
    """Interface of one adjustment to the least-squares loop, and its memory on the device."""

    def __init__(
        self, bundle: CudaDenseBundle, problem: BundleProblem, options: BundleOptions
    ) -> None:
        self.grid = bundle.grid
        self.problem = problem
        self.options = options
        self.kernels = bundle.kernels
        self.solvers = bundle.solvers
        self.matches = problem.pixels.contiguous(), problem.weight.contiguous()
        d = problem.inverse_depth
        self.structure = s = bundle.structure_of(problem)
        self.edges = LinearisedEdges(self.kernels, s.edges, d)
        self.depth_terms = KernelDepthTerms.of(problem.depth_terms)
        size = 6 * s.poses
        pairs = len(s.edges.pair_a)
        like = d.new_empty(0, dtype=torch.float64)
        self.system = like.new_empty((size + 1) * size)
        """The camera system; the right-hand side is its last row."""
        self.inverses = like.new_empty(-(-size // PANEL) * PANEL * PANEL)
        self.good = like.new_empty(1, dtype=torch.int32)
        self.xi = like.new_zeros(6 * s.frames)
        self.delta = d.new_empty(d.numel())
        """Steps of the poses, and of the inverse depths."""
        self.blocks = like.new_empty(144 * pairs)
        self.vectors = like.new_empty(12 * pairs)

    def linearise(self, state: _State) -> bool:
        """Linearise edges, summed by source; return True."""
        self.edges.fill(
            self.grid, state.T, state.inverse_depth, self.matches, self.options, self.depth_terms
        )
        return True

    def step(self, state: _State, linear: bool, damping: float) -> Step[_State] | None:
        """Take a step on the device, which records whether it was not finite."""
        self._solve_cameras(state, damping)
        moved = self._moved(state)
        if not self.options.lowers_cost:
            return Step(moved)
        if bool(moved.failed.any()):
            return None
        return Step(moved, float(self.xi.abs().max()))

    def cost(self, state: _State, linear: bool) -> float:
        """Return the cost (twice the objective); waits for the GPU."""
        p = self.problem
        matched = edge_costs(
            self.kernels,
            self.structure.edges,
            self.grid,
            state.T,
            state.inverse_depth,
            self.matches,
            self.options.huber,
        )
        terms = sum(term.cost(state.everything) for term in p.depth_terms)
        if p.pose_terms:
            here = state.with_poses_here
            terms += sum(term.cost(here) for term in p.pose_terms)
        return float(matched.sum()) + terms

    def _solve_cameras(self, state: _State, damping: float) -> None:
        s = self.structure
        if not s.poses:
            return
        self.edges.eliminate(self.blocks, self.vectors)
        self.kernels["assemble_system"](
            len(s.places),
            256,
            s.places,
            s.first_part,
            s.parts,
            self.blocks,
            self.vectors,
            s.poses,
            damping,
            self.system,
        )
        self._add_pose_terms(state, damping)
        if s.poses <= MAX_FEW:
            threads = min(256, 32 * s.poses)
            self.solvers["solve_few_poses"](
                1, threads, self.system, s.slot, s.poses, s.frames, self.xi
            )
        else:
            self._solve_many_poses()

    def _add_pose_terms(self, state: _State, damping: float) -> None:
        """Add the pose terms to the assembled camera system; waits for the GPU."""
        problem = self.problem
        if not problem.pose_terms:
            return
        poses = DenseCameraSystem(problem.free_pose.cpu())
        here = state.with_poses_here
        for term in problem.pose_terms:
            poses.add(term.hyper_edges(here))
        hessian = poses.hessian[poses.free[:, None], poses.free]
        # Only the lower blocks of the system on the device are used.
        diagonal = hessian.diagonal()
        diagonal += damping * diagonal.abs()
        added = torch.cat([hessian, poses.gradient[poses.free][None]])
        self.system += to_device(added.reshape(-1), self.system.device)

    def _solve_many_poses(self) -> None:
        """Solve by Cholesky's method, panel by panel."""
        s = self.structure
        size = 6 * self.structure.poses
        for k in range(0, size, PANEL):
            self.solvers["factor_panel"](1, 256, self.system, size, k, self.inverses, self.good)
            # The right-hand side is a row below every panel.
            tiles = -(-(size + 1 - min(k + PANEL, size)) // TILE)
            self.solvers["substitute_panel"](tiles, 256, self.system, size, k, self.inverses)
            if k + PANEL < size:
                self.solvers["update_rest"]((tiles, tiles), 256, self.system, size, k)
        threads = min(1024, 32 * s.poses)
        self.solvers["substitute_back"](
            1, threads, self.system, size, self.inverses, self.good, s.slot, s.frames, self.xi
        )

    def _moved(self, state: _State) -> _State:
        s = self.structure
        edges = self.edges
        moved = state.copy()
        edges.find_depth_steps(self.xi, self.delta, moved.failed)
        self.kernels["take_steps"](
            (-(-edges.cells // edges.block), s.frames),
            edges.block,
            s.slot,
            s.edges.free_depth,
            self.xi,
            self.delta,
            edges.cells,
            *INVERSE_DEPTHS,
            moved.failed,
            moved.T,
            moved.inverse_depth,
        )
        return moved
