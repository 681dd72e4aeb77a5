"""Dense bundle adjustment of problems whose linearised edges would not fit into memory.

The same steps as ``DenseBundle``. Matches are fetched and linearised some edges at a time, their
share of the camera system is added up, and nothing of them is kept; once the poses are known, the
edges are projected a second time for the steps of the inverse depths.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.dense import (
    BundleOptions,
    BundleProblem,
    BundleResult,
    Star,
    damped_curvature,
    linearise,
    linearise_stars,
    move,
    relative_motion,
    robust_weight,
    source_chunks,
    sources_within,
)
from geogs.geometry.lie import se3_adjoint
from geogs.keyframes.grid import SampleGrid
from geogs.threads import thread_map, worker_count

T = TypeVar("T")

Matches = Callable[[slice], tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]]
"""Measured positions and their inverse variances for a slice of edges; asked from threads."""


@dataclass(frozen=True)
class StreamedProblem:
    """As ``BundleProblem``, on the CPU, with the matches fetched when they are needed."""

    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]
    source: Int[Tensor, "e"]
    target: Int[Tensor, "e"]
    matches: Matches
    free_pose: Bool[Tensor, "n"]
    free_depth: Bool[Tensor, "n"]
    damping: Float[Tensor, "n p"] | None = None

    def part(self, edges: slice) -> BundleProblem:
        """The same frames with some of the edges."""
        pixels, weight = self.matches(edges)
        return BundleProblem(
            self.T_cw, self.inverse_depth, self.source[edges], self.target[edges], pixels, weight,
            self.free_pose, self.free_depth, self.damping,
        )  # fmt: skip


@dataclass(frozen=True)
class _State:
    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "n p"]


class StreamedBundle:
    """Solver for one grid on the CPU; memory grows with the frames and the blocks they span."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def solve(self, problem: StreamedProblem, options: BundleOptions | None = None) -> BundleResult:
        """Take ``options.iterations`` damped Gauss-Newton steps, or fewer (``tolerance``).

        A step that is not finite is not taken and ``finite`` is False in the result.
        """
        options = options or BundleOptions()
        state = _State(problem.T_cw, problem.inverse_depth)
        information = torch.zeros_like(problem.inverse_depth)
        residual = problem.inverse_depth.new_zeros(len(problem.source))
        system = SparseCameraSystem(problem.source, problem.target, problem.free_pose)
        chunks = source_chunks(problem.source, options.chunk)
        for _ in range(options.iterations):
            system.clear()
            for chunk, stars in self._linearised(problem, state, options, chunks):
                system.add(stars)
                residual[chunk] = torch.cat([star.residual for star in stars])
                for star in stars:
                    information[star.frame] = star.information
            xi = system.solve(options.damping)
            delta = self._depth_steps(problem, state, xi, options, chunks)
            if not bool(torch.isfinite(xi).all() and torch.isfinite(delta).all()):
                return BundleResult(
                    state.T_cw, state.inverse_depth, information, residual, finite=False
                )
            state = _moved(problem, state, xi, delta, options)
            if float(xi.abs().max()) < options.tolerance:
                break
        return BundleResult(state.T_cw, state.inverse_depth, information, residual, finite=True)

    def _linearised(
        self,
        problem: StreamedProblem,
        state: _State,
        options: BundleOptions,
        chunks: Sequence[slice],
    ) -> Iterator[tuple[slice, list[Star]]]:
        def work(chunk: slice) -> tuple[slice, list[Star]]:
            part = problem.part(chunk)
            stars = linearise_stars(
                self.grid, part, state.T_cw, state.inverse_depth, options, slice(None)
            )
            # The coupling with the depths is most of a star; it is not needed again.
            return chunk, [replace(star, depth=None) for star in stars]

        return _few_at_a_time(work, chunks)

    def _depth_steps(
        self,
        problem: StreamedProblem,
        state: _State,
        xi: Float[Tensor, "n 6"],
        options: BundleOptions,
        chunks: Sequence[slice],
    ) -> Float[Tensor, "n p"]:
        """Back-substitution: sum_e w dp/dd (r - dp/dxi xi_rel) over the damped curvature."""

        def work(chunk: slice) -> list[tuple[int, Tensor]]:
            part = problem.part(chunk)
            i, j = part.source, part.target
            T_ji = relative_motion(state.T_cw, i, j)
            p = linearise(self.grid.camera, self.grid.rays, T_ji, state.inverse_depth[i])
            r = part.pixels - p.pixels
            w = robust_weight(r, part.weight * p.valid[..., None], options.huber)
            relative = (xi[j] - (se3_adjoint(T_ji) @ xi[i][..., None])[..., 0]).to(r)
            moved = (p.pose_jacobian * relative[:, :, None, None]).sum(1).mT
            curvature = (w * p.depth_jacobian.square()).sum(-1)
            gradient = (w * p.depth_jacobian * (r - moved)).sum(-1)
            return [
                (
                    frame,
                    gradient[e].sum(0)
                    / damped_curvature(part, frame, curvature[e].sum(0), options),
                )
                for frame, e in sources_within(i)
                if bool(part.free_depth[frame])
            ]

        delta = torch.zeros_like(state.inverse_depth)
        for steps in _few_at_a_time(work, chunks):
            for frame, step in steps:
                delta[frame] = step
        return delta


def _few_at_a_time(work: Callable[[slice], T], chunks: Sequence[slice]) -> Iterator[T]:
    """Results in order, worked on side by side, a few of them held at a time."""
    group = 8 * worker_count()
    for start in range(0, len(chunks), group):
        yield from thread_map(work, chunks[start : start + group])


def _moved(
    problem: StreamedProblem,
    state: _State,
    xi: Float[Tensor, "n 6"],
    delta: Float[Tensor, "n p"],
    options: BundleOptions,
) -> _State:
    T = torch.where(problem.free_pose[:, None, None], move(xi, state.T_cw), state.T_cw)
    d = (state.inverse_depth + delta).clamp(options.min_inverse_depth, options.max_inverse_depth)
    return _State(T, torch.where(problem.free_depth[:, None], d, problem.inverse_depth))
