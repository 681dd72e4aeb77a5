"""Dense bundle adjustment of problems whose linearised edges would not fit into memory.

The same steps as ``DenseBundle``. Matches are fetched and linearised some edges at a time, their
share of the camera system is added up, and nothing of them is kept; once the poses are known, the
edges are projected a second time for the steps of the inverse depths.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.base import BundleOptions, BundleResult
from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.dense import stepped
from geogs.bundle.linearise import (
    Star,
    damped_curvature,
    linearise_stars,
    motion_stars,
    weighed_residuals,
)
from geogs.bundle.problem import StreamedProblem, known_before, source_chunks, sources_within
from geogs.bundle.projection import linearise, relative_motion
from geogs.geometry.lie import se3_adjoint
from geogs.threads import thread_map, worker_count
from geogs.world.grid import SampleGrid

R = TypeVar("R")


class StreamedBundle:
    """Solver for one grid on the CPU; memory grows with the frames and the blocks they span."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def solve(self, problem: StreamedProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` damped Gauss-Newton steps, or fewer (``tolerance``).

        A step that is not finite is not taken and ``finite`` is False in the result.
        """
        options = options or BundleOptions()
        T, d = problem.T_cw, problem.inverse_depth
        information = known_before(problem)
        residual = d.new_zeros(len(problem.source))
        finite = True
        system = SparseCameraSystem(*problem.joined(), problem.free_pose)
        chunks = source_chunks(problem.source, options.chunk)
        for _ in range(options.iterations):
            system.clear()
            for chunk, stars in self.linearised(problem, T, d, options, chunks):
                system.add(stars)
                residual[chunk] = torch.cat([star.residual for star in stars])
                for star in stars:
                    information[star.frame] = star.information
            system.add(motion_stars(problem.motions, T))
            xi = system.solve(options.damping)
            delta = self.depth_steps(problem, T, d, xi, options, chunks)
            if not bool(torch.isfinite(xi).all() and torch.isfinite(delta).all()):
                finite = False
                break
            T, d = stepped(problem, T, d, xi, delta, options)
            if float(xi.abs().max()) < options.tolerance:
                break
        return BundleResult(T, d, information, residual, finite)

    def linearised(
        self,
        problem: StreamedProblem,
        T: Float[Tensor, "n 4 4"],
        d: Float[Tensor, "n p"],
        options: BundleOptions,
        chunks: Sequence[slice],
    ) -> Iterator[tuple[slice, list[Star]]]:
        """What the edges of each chunk say of the poses; stars without their depths."""

        def work(chunk: slice) -> tuple[slice, list[Star]]:
            stars = linearise_stars(
                self.grid.camera, self.grid.rays, problem.part(chunk), T, d, options
            )
            # The coupling with the depths is most of a star; it is not needed again.
            return chunk, [replace(star, depth=None) for star in stars]

        return _few_at_a_time(work, chunks)

    def depth_steps(
        self,
        problem: StreamedProblem,
        T: Float[Tensor, "n 4 4"],
        d: Float[Tensor, "n p"],
        xi: Float[Tensor, "n 6"],
        options: BundleOptions,
        chunks: Sequence[slice],
    ) -> Float[Tensor, "n p"]:
        """Steps of the inverse depths after those of the poses.

        Back-substitution: sum_e w dp/dd (r - dp/dxi xi_rel) over the damped curvature.
        """

        def work(chunk: slice) -> list[tuple[int, Tensor]]:
            part = problem.part(chunk)
            i, j = part.source, part.target
            T_ji = relative_motion(T, i, j)
            p = linearise(self.grid.camera, self.grid.rays, T_ji, d[i])
            r, w = weighed_residuals(p, part.pixels, part.weight, options.huber)
            relative = (xi[j] - (se3_adjoint(T_ji) @ xi[i][..., None])[..., 0]).to(r)
            moved = (p.pose_jacobian * relative[:, :, None, None]).sum(1).mT
            curvature = (w * p.depth_jacobian.square()).sum(-1)
            gradient = (w * p.depth_jacobian * (r - moved)).sum(-1)
            steps = []
            for frame, e in sources_within(i):
                if bool(part.free_depth[frame]):
                    c, extra = curvature[e].sum(0), part.damping_of(frame)
                    damped = damped_curvature(c, options.depth_damping, extra)
                    b = gradient[e].sum(0)
                    if part.measured is not None:
                        curved, pull = part.measured.pull(frame, d[frame])
                        damped, b = damped + curved, b + pull
                    steps.append((frame, b / damped))
            return steps

        delta = torch.zeros_like(d)
        for steps in _few_at_a_time(work, chunks):
            for frame, step in steps:
                delta[frame] = step
        return delta


def _few_at_a_time(work: Callable[[slice], R], chunks: Sequence[slice]) -> Iterator[R]:
    """Results in order, worked on side by side, a few of them held at a time."""
    group = 8 * worker_count()
    for start in range(0, len(chunks), group):
        yield from thread_map(work, chunks[start : start + group])
