"""Motion-only adjustment on the CPU: poses of frames seen from keyframes that stay fixed."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.linearise import normal_equations, weighed_residuals
from geogs.bundle.problem import MotionProblem
from geogs.bundle.projection import linearise, project
from geogs.geometry.lie import move, se3_inverse
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe


class CpuMotion:
    """Solver for some cells of a grid, or for all of them."""

    def __init__(self, grid: SampleGrid, cells: Int[Tensor, "p"] | None = None) -> None:
        self.grid = grid
        self.rays = grid.rays if cells is None else grid.rays[cells]

    def solve(
        self, problem: MotionProblem, iterations: int = 4, huber: float = 3.0
    ) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "e p 2"]]:
        """As in the protocol."""
        camera, rays, d = self.grid.camera, self.rays, problem.inverse_depth
        T, frame, inverse = problem.T_cw, problem.frame, se3_inverse(problem.T_source)
        for _ in range(iterations):
            p = linearise(camera, rays, T[frame] @ inverse, d)
            r, w = weighed_residuals(p, problem.pixels, problem.weight, huber)
            edge_H, edge_g = normal_equations(p.pose_jacobian * w.mT[:, None], p.pose_jacobian, r)
            H = T.new_zeros(len(T), 6, 6).index_add_(0, frame, edge_H)
            g = T.new_zeros(len(T), 6).index_add_(0, frame, edge_g)
            damping = 1e-4 * H.diagonal(dim1=-2, dim2=-1) + 1e-6
            xi = torch.linalg.solve(H + torch.diag_embed(damping), g)
            T = move(xi.nan_to_num(0.0, 0.0, 0.0), T)
        final = project(camera, rays, T[frame] @ inverse, d)
        return T, problem.pixels - final.pixels

    def fit(
        self,
        T_guess: Float[Tensor, "4 4"],
        keyframe: Keyframe,
        pixels: Float[Tensor, "p 2"],
        weight: Float[Tensor, "p 2"],
        iterations: int,
        huber: float,
        limit: float,
    ) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "4 4"], Float[Tensor, "6"]]:
        """As in the protocol."""
        informed = keyframe.information > 0
        placed = keyframe.has_known_depth & (weight[:, 0] > 0)
        weight = weight * informed[:, None]
        frame = torch.zeros(1, dtype=torch.long)
        T, residual = self.solve(
            MotionProblem(
                T_guess[None], keyframe.inverse_depth[None], keyframe.T_cw[None], frame,
                pixels[None], weight[None],
            ),
            iterations, huber,
        )  # fmt: skip
        used = weight[:, 0] > 0
        error, flow = residual[0].norm(dim=-1), (pixels - self.grid.pixels).norm(dim=-1)
        agree = used & (error < limit)
        matched, agreeing, known, sure = (x.float().mean() for x in (used, agree, informed, placed))
        medians = error[used].median(), flow[used].median()
        T_ji = T[0] @ se3_inverse(keyframe.T_cw)
        return T[0], T_ji, torch.stack([matched, agreeing, *medians, known, sure])
