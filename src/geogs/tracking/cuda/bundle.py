"""Dense bundle adjustment on the GPU: a handful of launches per step, one wait per solve."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.tracking.bundle import BundleOptions, BundleProblem, BundleResult
from geogs.tracking.grid import SampleGrid

MAX_SMALL = 16
"""Free poses up to which one block solves the camera system; ``MAX_POSES`` of the source."""


def block_size(cells: int) -> int:
    """Threads of a block that goes over the cells of an edge: whole warps, 64 to 256."""
    return max(64, min(-(-cells // 32) * 32, 256))


@dataclass(frozen=True)
class _Structure:
    """Which frames and edges there are, as index arrays on the device."""

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
    free: Tensor
    """Frames with free poses."""

    @property
    def frames(self) -> int:
        return len(self.slot)

    @property
    def edges(self) -> int:
        return len(self.source)

    @property
    def poses(self) -> int:
        return len(self.free)


def _structure(problem: BundleProblem, device: torch.device) -> _Structure:
    """The index arrays, sent to the device in one piece."""
    source, target, free_pose, free_depth = (
        x.cpu().numpy()
        for x in (problem.source, problem.target, problem.free_pose, problem.free_depth)
    )
    first = np.searchsorted(source, np.arange(len(free_pose) + 1))
    pairs = [
        begin + (np.stack(np.tril_indices(end - begin)) if joined else np.arange(end - begin))
        for begin, end, joined in zip(first[:-1], first[1:], free_depth, strict=True)
    ]
    b, a = np.concatenate([np.broadcast_to(p, (2, p.shape[-1])) for p in pairs], 1)
    slot = np.where(free_pose, np.cumsum(free_pose) - 1, -1)
    parts = [source, target, first, slot, free_depth, a, b, np.flatnonzero(free_pose)]
    sent = torch.from_numpy(np.concatenate(parts).astype(np.int32)).to(device, non_blocking=True)
    return _Structure(*sent.split([len(p) for p in parts]))


class _Workspace:
    """State of one solve on the device."""

    def __init__(self, problem: BundleProblem, device: torch.device) -> None:
        d = problem.inverse_depth
        self.structure = s = _structure(problem, device)
        edges, cells = s.edges, d.shape[1]
        self.cells = cells
        # Poses and the sign of failure travel back together.
        self.state = torch.zeros(16 * s.frames + 1, dtype=torch.float64, device=device)
        self.state[: 16 * s.frames].copy_(problem.T_cw.reshape(-1), non_blocking=True)
        self.T = self.state[: 16 * s.frames]
        self.failed = self.state[16 * s.frames :].view(torch.int32)
        self.inverse_depth = d.clone()
        self.system = torch.zeros(
            (6 * s.poses) ** 2 + 6 * s.poses, dtype=torch.float64, device=device
        )
        self.H, self.g = self.system.split([(6 * s.poses) ** 2, 6 * s.poses])
        self.xi = self.system.new_zeros(6 * s.frames)
        self.motion = self.system.new_empty(12 * edges)
        self.normal = self.system.new_empty(32 * edges)
        self.coupling = d.new_empty(6 * edges * cells)
        self.curvature, self.gradient = d.new_empty(2, edges * cells).unbind()
        self.information = torch.zeros_like(d)
        self.inverse_curvature, self.depth_gradient, self.delta = d.new_empty(3, d.numel()).unbind()
        self.residual = d.new_zeros(edges)

    @cached_property
    def free(self) -> Tensor:
        return self.structure.free.long()


class CudaDenseBundle:
    """Solver for one grid on its GPU, with the interface of ``DenseBundle``.

    Only the inverse depths, pixels and weights of a problem need to be on the device; with the rest
    on the CPU nothing waits until the result is fetched.
    """

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid
        device = torch.device(grid.device)
        self._step = kernels_for(Path(__file__).with_name("bundle.cu"), device)
        self._solve = kernels_for(Path(__file__).with_name("bundle_solve.cu"), device)

    def solve(self, problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` damped Gauss-Newton steps.

        A step that is not finite is not taken and ``finite`` is False in the result. Poses are
        returned where they were given.
        """
        options = options or BundleOptions()
        w = _Workspace(problem, problem.inverse_depth.device)
        pixels, weight = problem.pixels.contiguous(), problem.weight.contiguous()
        for _ in range(options.iterations):
            self._linearise(w, pixels, weight, options)
            self._solve_cameras(w, options)
            self._move(w, options)
        state = w.state.cpu()
        T = state[:-1].reshape(-1, 4, 4).to(problem.T_cw.device)
        finite = int(state[-1:].view(torch.int32)[0]) == 0
        return BundleResult(T, w.inverse_depth, w.information, w.residual, finite)

    def _linearise(
        self, w: _Workspace, pixels: Tensor, weight: Tensor, options: BundleOptions
    ) -> None:
        s, c, block = w.structure, self.grid.camera, block_size(w.cells)
        self._step["linearise_edges"](
            s.edges, block, w.T, w.inverse_depth, s.source, s.target, pixels, weight,
            self.grid.rays, w.cells, c.fx, c.fy, c.cx, c.cy, options.huber, w.system,
            len(w.system), w.motion, w.normal, w.coupling, w.curvature, w.gradient, w.residual,
        )  # fmt: skip
        self._step["sum_sources"](
            s.frames, block, s.first, w.curvature, w.gradient, w.cells, options.depth_damping,
            w.information, w.inverse_curvature, w.depth_gradient,
        )  # fmt: skip

    def _solve_cameras(self, w: _Workspace, options: BundleOptions) -> None:
        s = w.structure
        if not s.poses:
            return
        self._step["eliminate_depths"](
            len(s.pair_a), block_size(w.cells), s.pair_a, s.pair_b, s.source, s.target, s.slot,
            s.free_depth, w.coupling, w.inverse_curvature, w.depth_gradient, w.motion, w.normal,
            w.cells, 6 * s.poses, w.H, w.g,
        )  # fmt: skip
        if s.poses <= MAX_SMALL:
            threads = min(256, 32 * s.poses)
            self._solve["solve_camera_system"](
                1, threads, w.H, w.g, s.slot, s.poses, s.frames, options.damping, w.xi
            )
            return
        H = w.H.reshape(6 * s.poses, 6 * s.poses)
        diagonal = H.diagonal()
        diagonal.add_(options.damping * diagonal.abs() + 1e-2)
        factor, info = torch.linalg.cholesky_ex(H)
        steps = torch.cholesky_solve(w.g[:, None], factor).reshape(-1, 6)
        w.xi.view(-1, 6)[w.free] = torch.where(info == 0, steps, torch.nan)

    def _move(self, w: _Workspace, options: BundleOptions) -> None:
        s, block = w.structure, block_size(w.cells)
        grid = (-(-w.cells // block), s.frames)
        self._step["find_depth_steps"](
            grid, block, s.first, s.target, s.free_depth, w.motion, w.xi, w.coupling,
            w.inverse_curvature, w.depth_gradient, w.cells, w.delta, w.failed,
        )  # fmt: skip
        self._step["take_steps"](
            grid, block, s.slot, s.free_depth, w.xi, w.delta, w.cells, options.min_inverse_depth,
            options.max_inverse_depth, w.failed, w.T, w.inverse_depth,
        )  # fmt: skip
