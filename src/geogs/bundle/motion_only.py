"""Motion-only adjustment on the CPU: poses of frames relative to fixed keyframes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.flow_term import normal_equations, weighed_residuals
from geogs.bundle.problem import MotionProblem
from geogs.bundle.projection import linearise, project
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.lie import move, se3_inverse
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe


class MotionSolver:
    """Estimates poses of frames relative to fixed keyframes, on the CPU.

    Matches are those of some cells of a grid, or of all of them.
    """

    def __init__(self, grid: SampleGrid, cells: Int[Tensor, "p"] | None = None) -> None:
        self.grid = grid
        self.rays = grid.rays if cells is None else grid.rays[cells]

    def solve(
        self, problem: MotionProblem, iterations: int = 4, huber: float = 3.0
    ) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "e p 2"]]:
        """Adjust each pose separately; return the poses and the residuals of the edges at them."""
        camera = self.grid.camera
        rays = self.rays
        d = problem.inverse_depth
        frame = problem.frame
        to_source = se3_inverse(problem.T_source)

        def linearised(T: Float[Tensor, "n 4 4"]) -> tuple[Tensor, Tensor]:
            p = linearise(camera, rays, T[frame] @ to_source, d)
            r, w = weighed_residuals(p, problem.pixels, problem.weight, huber)
            edge_H, edge_g = normal_equations(p.pose_jacobian * w.mT[:, None], p.pose_jacobian, r)
            H = T.new_zeros(len(T), 6, 6).index_add_(0, frame, edge_H)
            return H, T.new_zeros(len(T), 6).index_add_(0, frame, edge_g)

        def step(
            T: Float[Tensor, "n 4 4"], linear: tuple[Tensor, Tensor], damping: float
        ) -> Step[Tensor]:
            """Take a step; a pose whose step is not finite does not change."""
            H, g = linear
            raised = damping * H.diagonal(dim1=-2, dim2=-1) + 1e-6
            xi = torch.linalg.solve(H + torch.diag_embed(raised), g)
            return Step(move(xi.nan_to_num(0.0, 0.0, 0.0), T))

        T = minimise(problem.T_cw, linearised, step, Policy(iterations, damping=1e-4)).state
        return T, problem.pixels - project(camera, rays, T[frame] @ to_source, d).pixels

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
        """Fit the pose of a frame to one keyframe, with statistics for its acceptance.

        Cells without information do not count. Returns the pose; the motion from the keyframe to
        it; and in one tensor the fraction of matched cells, the fraction with a residual below
        ``limit`` pixels, the medians over matched cells of residual, motion and parallax (motion
        beyond the camera's rotation), in pixels and NaN without matches, the fraction of cells with
        information, and the fraction of matched cells with known depth
        (``Keyframe.has_known_depth``). On a GPU all stays there, and nothing waits.
        """
        informed = keyframe.information > 0
        placed = keyframe.has_known_depth & (weight[:, 0] > 0)
        weight = weight * informed[:, None]
        frame = torch.zeros(1, dtype=torch.long)
        T, residual = self.solve(
            MotionProblem(
                T_guess[None],
                keyframe.inverse_depth[None],
                keyframe.T_cw[None],
                frame,
                pixels[None],
                weight[None],
            ),
            iterations,
            huber,
        )
        used = weight[:, 0] > 0
        T_ji = T[0] @ se3_inverse(keyframe.T_cw)
        infinite = self.grid.pixels.new_zeros(1, len(self.rays))
        turned = project(self.grid.camera, self.rays, T_ji[None], infinite).pixels[0]
        error, flow, parallax = (
            x.norm(dim=-1) for x in (residual[0], pixels - self.grid.pixels, pixels - turned)
        )
        agree = used & (error < limit)
        fractions = (x.float().mean() for x in (used, agree, informed, placed))
        matched, agreeing, known, placed_fraction = fractions
        medians = (x[used].median() for x in (error, flow, parallax))
        return T[0], T_ji, torch.stack([matched, agreeing, *medians, known, placed_fraction])
