"""Dense bundle adjustment of problems whose linearised edges would not fit into memory.

The same steps as ``DenseBundle``. Matches are fetched and linearised some edges at a time, what
they say of the camera system is added up, and nothing of them is kept; once the poses are known,
the edges are projected a second time for the steps of the inverse depths.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.dense import FLOOR
from geogs.bundle.flow_term import SourceFlow, linearised_sources
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import StreamedProblem, source_chunks
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.schur import SchurBundle
from geogs.bundle.terms import BundleState
from geogs.threads import thread_map, worker_count
from geogs.world.grid import SampleGrid

R = TypeVar("R")


class StreamedBundle:
    """Solver for one grid on the CPU; memory grows with the frames and the blocks they span."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def solve(self, problem: StreamedProblem, options: BundleOptions) -> BundleResult:
        return StreamedSchur(problem, self.grid, options).adjusted()


class StreamedSchur(SchurBundle[StreamedProblem, SparseCameraSystem]):
    """One adjustment that keeps nothing but the camera system of what it linearises."""

    def __init__(self, problem: StreamedProblem, grid: SampleGrid, options: BundleOptions) -> None:
        super().__init__(problem, options)
        self.flow = LensFlow.of(grid)
        self.system = SparseCameraSystem(*problem.joined(), problem.free_pose)
        self.chunks: Sequence[slice] = source_chunks(problem.source, options.chunk)

    def linearise(self, state: BundleState) -> SparseCameraSystem:
        """Chunk by chunk, several side by side."""
        self.system.clear()
        self.add_matches(state)
        for term in self.problem.pose_terms:
            self.system.add(term.hyper_edges(state))
        return self.system

    def add_matches(self, state: BundleState) -> None:
        """Add what matches and other terms of depths say of the poses to the camera system."""

        def work(chunk: slice) -> list[SourceFlow]:
            part = self.problem.part(chunk)
            sources = linearised_sources(self.flow, part, state, self.options)
            # The coupling with the depths is most of it, and not needed again.
            return [replace(s, edges=s.edges.without_coupling()) for s in sources]

        for sources in _few_at_a_time(work, self.chunks):
            self.system.add(source.edges for source in sources)
            for source in sources:
                self.information[source.frame] = source.information

    def flow_cost(self, state: BundleState) -> float:
        """Chunk by chunk, several side by side."""

        def work(chunk: slice) -> float:
            return self.flow.cost(self.problem.part(chunk), state, self.options.huber)

        return sum(_few_at_a_time(work, self.chunks))

    def solve_cameras(self, linear: SparseCameraSystem, damping: float) -> Tensor | None:
        """The solution by the Cholesky factor of a band."""
        return linear.solve(damping, FLOOR)

    def depth_steps(
        self, state: BundleState, linear: SparseCameraSystem, step: Float[Tensor, "v"]
    ) -> Float[Tensor, "n p"]:
        """The depths that follow by matches that are linearised a second time."""

        def work(chunk: slice) -> list[tuple[int, Tensor]]:
            part, frames, found = self.problem.part(chunk), len(state.T_cw), []
            for source in self.flow.sources(part, state, self.options):
                if bool(part.free_depth[source.frame]):
                    depth = source.edges.depth_after(step, frames)
                    for term in part.depth_terms:
                        depth = depth.plus(term.of_frame(source.frame, state))
                    found.append((source.frame, depth.solution))
            return found

        delta = torch.zeros_like(state.inverse_depth)
        for found in _few_at_a_time(work, self.chunks):
            for frame, own in found:
                delta[frame] = own
        return delta


def _few_at_a_time(work: Callable[[slice], R], chunks: Sequence[slice]) -> Iterator[R]:
    """Results in order, worked on side by side, a few of them kept at a time."""
    group = 8 * worker_count()
    for start in range(0, len(chunks), group):
        yield from thread_map(work, chunks[start : start + group])
