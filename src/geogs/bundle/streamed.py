"""Dense bundle adjustment of problems whose linearised edges would not fit into memory.

The same steps as ``DenseBundle``. Matches are fetched and linearised some edges at a time, added to
the camera system, and not kept; once the poses are known, the edges are linearised a second time
for the steps of the inverse depths.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.dense import FLOOR
from geogs.bundle.flow_term import SourceFlow, linearised_sources
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.schur import FlowSchur
from geogs.bundle.terms import BundleState
from geogs.world.grid import SampleGrid


class StreamedBundle:
    """Solver for one grid on the CPU; memory grows with the number of frames and of blocks."""

    def __init__(self, grid: SampleGrid) -> None:
        self.grid = grid

    def solve(self, problem: StreamedProblem, options: BundleOptions) -> BundleResult:
        return StreamedSchur(problem, self.grid, options).adjusted()


class StreamedSchur(FlowSchur[StreamedProblem, SparseCameraSystem]):
    """One adjustment that only keeps the camera system of linearised edges."""

    def __init__(self, problem: StreamedProblem, grid: SampleGrid, options: BundleOptions) -> None:
        super().__init__(problem, LensFlow.of(grid), options)
        self.system = SparseCameraSystem(*problem.joined(), problem.free_pose)

    def linearise(self, state: BundleState) -> SparseCameraSystem:
        """Linearise chunk by chunk, several in parallel."""
        self.system.clear()
        self.add_matches(state)
        for term in self.problem.pose_terms:
            self.system.add(term.hyper_edges(state))
        return self.system

    def add_matches(self, state: BundleState) -> None:
        """Add matches and depth terms, with depths eliminated, to the camera system."""

        def work(part: BundleProblem) -> list[SourceFlow]:
            sources = linearised_sources(self.flow, part, state, self.options)
            # The coupling with the depths is large, and not needed again.
            return [replace(s, edges=s.edges.without_coupling()) for s in sources]

        for sources in self.by_parts(work):
            self.system.add(source.edges for source in sources)
            for source in sources:
                self.information[source.frame] = source.edges.depth.information

    def solve_cameras(self, linear: SparseCameraSystem, damping: float) -> Tensor | None:
        """Solve by the Cholesky factor of a band."""
        return linear.solve(damping, FLOOR)

    def depth_steps(
        self, state: BundleState, linear: SparseCameraSystem, step: Float[Tensor, "v"]
    ) -> Float[Tensor, "n p"]:
        """Compute the depth steps from matches linearised a second time."""

        def work(part: BundleProblem) -> list[tuple[int, Tensor]]:
            frames = len(state.T_cw)
            found = []
            for source in self.flow.sources(part, state, self.options):
                if bool(part.free_depth[source.frame]):
                    depth = source.edges.depth_after(step, frames)
                    for term in part.depth_terms:
                        depth = depth.plus(term.of_frame(source.frame, state))
                    found.append((source.frame, depth.solution))
            return found

        delta = torch.zeros_like(state.inverse_depth)
        for found in self.by_parts(work):
            for frame, own in found:
                delta[frame] = own
        return delta
