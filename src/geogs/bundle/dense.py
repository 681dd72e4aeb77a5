"""Dense bundle adjustment over poses and inverse depths on the CPU.

Gauss-Newton on ``sum_e sum_p rho(|W^(1/2) (target - project(T_j T_i^-1, d_i))|)``, DROID-SLAM's
dense BA layer, see :mod:`geogs.bundle.flow_term`, and on the problem's other terms. Linearised
edges are kept until the next step, and the camera system is dense.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.camera_system import DenseCameraSystem
from geogs.bundle.flow_term import SourceFlow, linearised_sources
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.schur import FlowSchur
from geogs.bundle.terms import BundleState
from geogs.world.grid import SampleGrid

FLOOR = 1e-2
"""Constant added to the diagonal of the camera system, besides damping."""


class DenseBundle:
    """Solver for one grid on the CPU; holds no state between calls."""

    def __init__(self, grid: SampleGrid) -> None:
        self.flow = LensFlow.of(grid)

    def solve(self, problem: BundleProblem, options: BundleOptions) -> BundleResult:
        return DenseSchur(problem, self.flow, options).adjusted()


@dataclass(frozen=True)
class LinearBundle:
    """A problem linearised at one state."""

    system: DenseCameraSystem
    sources: list[SourceFlow]
    """Sources, with all terms of their depths."""


class DenseSchur(FlowSchur[BundleProblem, LinearBundle]):
    """One adjustment that keeps all linearised edges."""

    floor = FLOOR

    def linearise(self, state: BundleState) -> LinearBundle:
        """Linearise all edges, always summed in the same order."""
        problem = self.problem

        def work(part: BundleProblem) -> list[SourceFlow]:
            return linearised_sources(self.flow, part, state, self.options)

        sources = [source for found in self.by_parts(work) for source in found]
        free_shared = () if state.block is None else state.block.free
        system = DenseCameraSystem(problem.free_pose, free_shared)
        system.add(source.edges for source in sources)
        for term in problem.pose_terms:
            system.add(term.hyper_edges(state))
        for source in sources:
            self.information[source.frame] = source.edges.depth.information
        return LinearBundle(system, sources)

    def solve_cameras(self, linear: LinearBundle, damping: float) -> Float[Tensor, "v"] | None:
        """Solve by Cholesky's method."""
        return linear.system.solve(damping, self.floor)

    def depth_steps(
        self, state: BundleState, linear: LinearBundle, step: Float[Tensor, "v"]
    ) -> Float[Tensor, "n p"]:
        """Compute the depth steps from the stored couplings."""
        delta = torch.zeros_like(state.inverse_depth)
        for source in linear.sources:
            if bool(self.problem.free_depth[source.frame]):
                delta[source.frame] = source.edges.depth_after(step, len(state.T_cw)).solution
        return delta
