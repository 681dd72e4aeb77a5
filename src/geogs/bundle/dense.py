"""Dense bundle adjustment over poses and inverse depths on the CPU.

Gauss-Newton on ``sum_e sum_p rho(|W^(1/2) (target - project(T_j T_i^-1, d_i))|)``, DROID-SLAM's
dense BA layer, see :mod:`geogs.bundle.linearise`. The reduced camera system is float64 and dense.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.base import BundleOptions, BundleResult
from geogs.bundle.linearise import Star, linearise_stars, motion_stars
from geogs.bundle.problem import BundleProblem, StreamedProblem, known_before, source_chunks
from geogs.geometry.lie import move
from geogs.threads import thread_map
from geogs.world.grid import SampleGrid


class DenseBundle:
    """Solver for one grid on the CPU; holds no state between calls."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def solve(self, problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
        """As in the protocol."""
        options = options or BundleOptions()
        T, d = problem.T_cw, problem.inverse_depth
        information = known_before(problem)
        residual = d.new_zeros(len(problem.source))
        finite = True
        for _ in range(options.iterations):
            stars = self._linearise(problem, T, d, options)
            for star in stars:
                information[star.frame] = star.information
            residual = torch.cat([star.residual for star in stars]) if stars else residual
            motions = motion_stars(problem.motions, T)
            xi = _pose_step(problem, [*stars, *motions], options.damping)
            delta = _depth_step(stars, xi, d)
            if not bool(torch.isfinite(xi).all() and torch.isfinite(delta).all()):
                finite = False
                break
            T, d = stepped(problem, T, d, xi, delta, options)
            if float(xi.abs().max()) < options.tolerance:
                break
        return BundleResult(T, d, information, residual, finite)

    def _linearise(
        self, problem: BundleProblem, T: Tensor, d: Tensor, options: BundleOptions
    ) -> list[Star]:
        """All stars; chunks of them side by side on the CPU, always in the same order."""
        chunks = source_chunks(problem.source, options.chunk)

        def work(chunk: slice) -> list[Star]:
            return linearise_stars(self.grid.camera, self.grid.rays, problem, T, d, options, chunk)

        parts = thread_map(work, chunks) if d.device.type == "cpu" else map(work, chunks)
        return [star for part in parts for star in part]


def stepped(
    problem: BundleProblem | StreamedProblem,
    T: Float[Tensor, "n 4 4"],
    d: Float[Tensor, "n p"],
    xi: Float[Tensor, "n 6"],
    delta: Float[Tensor, "n p"],
    options: BundleOptions,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n p"]]:
    """Poses and inverse depths, each on its device, after a step of those that are free."""
    d = (d + delta).clamp(options.min_inverse_depth, options.max_inverse_depth)
    return (
        torch.where(problem.free_pose[:, None, None], move(xi, T), T),
        torch.where(problem.free_depth[:, None].to(d.device), d, problem.inverse_depth),
    )


def _pose_step(problem: BundleProblem, stars: list[Star], damping: float) -> Float[Tensor, "n 6"]:
    """Solve the camera system; steps of all frames, zero for the fixed, NaN where it cannot be."""
    free = problem.free_pose
    n = int(free.sum())
    xi = torch.zeros(len(free), 6, dtype=torch.float64, device=free.device)
    if not n:
        return xi
    slot = torch.full((len(free),), -1, dtype=torch.long, device=free.device)
    slot[free] = torch.arange(n, device=free.device)
    H, g = xi.new_zeros(n, n, 6, 6), xi.new_zeros(n, 6)
    for star in stars:
        block, gradient = star.pose_blocks()
        at = slot[star.poses]
        keep = at >= 0
        at = at[keep]
        g.index_add_(0, at, gradient[keep])
        rows, columns = at[:, None].expand(-1, len(at)), at[None].expand(len(at), -1)
        H.index_put_((rows, columns), block[keep][:, keep], accumulate=True)
    H = H.transpose(1, 2).reshape(6 * n, 6 * n)
    H = H + torch.diag(damping * H.diagonal().abs() + 1e-2)
    factor, info = torch.linalg.cholesky_ex(H)
    solution = torch.cholesky_solve(g.reshape(-1, 1), factor)
    xi[free] = solution.reshape(n, 6) if not int(info) else torch.nan
    return xi


def _depth_step(
    stars: list[Star], xi: Float[Tensor, "n 6"], inverse_depth: Float[Tensor, "n p"]
) -> Float[Tensor, "n p"]:
    """Steps of the free inverse depths that go with those of the poses."""
    delta = torch.zeros_like(inverse_depth)
    for star in stars:
        if star.depth is not None:
            relative = xi[star.targets] - star.adjoint @ xi[star.frame]
            delta[star.frame] = star.depth.step(relative.reshape(-1))
    return delta
