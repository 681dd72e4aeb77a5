"""Poses of frames relative to fixed keyframes on the GPU: one launch for all iterations."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.cuda.linear_edges import LAUNCH_BOUND, block_size, edges_by_frame
from geogs.bundle.motion_only import MotionSolver
from geogs.bundle.problem import MotionProblem
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.world.keyframes import KNOWN, Keyframe

SOURCE = Path(__file__).with_name("motion.cu")


class CudaMotion(MotionSolver):
    """Solver for some cells of a grid, or for all of them.

    Poses and ``frame`` of a problem may be on the CPU; poses are returned on their device.
    """

    def solve(
        self, problem: MotionProblem, iterations: int = 4, huber: float = 3.0
    ) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "e p 2"]]:
        T_cw = problem.T_cw
        d = problem.inverse_depth
        frame = problem.frame.cpu()
        c = self.grid.camera
        n = len(T_cw)
        device = d.device
        first, order = edges_by_frame(frame, n, device)
        poses = to_device(torch.cat([T_cw, problem.T_source]), device)
        pixels = problem.pixels.contiguous()
        weight = problem.weight.contiguous()
        residual = torch.empty_like(pixels)
        kernels_for(SOURCE, device)["solve_poses"](
            n, block_size(d.shape[1], LAUNCH_BOUND), first, order, d.contiguous(), poses[n:],
            pixels, weight, None, self.rays, d.shape[1], *c.numbers, iterations, huber,
            poses, residual,
        )  # fmt: skip
        return poses[:n].to(T_cw.device), residual

    def fit(
        self,
        T_guess: Float[Tensor, "4 4"],
        keyframe: Keyframe,
        pixels: Float[Tensor, "p 2"],
        weight: Float[Tensor, "p 2"],
        iterations: int,
        huber: float,
        limit: float,
    ) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "4 4"], Float[Tensor, "7"]]:
        grid = self.grid
        c = self.grid.camera
        known = keyframe.information
        device = known.device
        threads = block_size(grid.size, LAUNCH_BOUND)
        # Both poses in one piece, followed by the results.
        found = torch.cat([torch.eye(4).reshape(-1), torch.zeros(7)]).to(T_guess)
        state = torch.cat([T_guess.reshape(-1), keyframe.T_cw.reshape(-1), found])
        state = to_device(state, device)
        T, T_source, T_ji, judged = state.split([16, 16, 16, 7])
        rows = torch.arange(2, dtype=torch.int32, device=device)
        pixels = pixels.contiguous()
        weight = weight.contiguous()
        residual = torch.empty_like(pixels)
        kernels = kernels_for(SOURCE, device)
        kernels["solve_poses"](
            1, threads, rows, rows, keyframe.inverse_depth, T_source, pixels, weight, known,
            self.rays, grid.size, *c.numbers, iterations, huber, T, residual,
        )  # fmt: skip
        kernels["judge_match"](
            1, threads, pixels, weight, known, keyframe.inverse_depth, residual, grid.pixels,
            self.rays, grid.size, *c.numbers, limit, KNOWN**2, T, T_source, judged,
            T_ji, shared=4 * grid.size,
        )  # fmt: skip
        return T.reshape(4, 4), T_ji.reshape(4, 4), judged
