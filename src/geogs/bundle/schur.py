"""Adjustment of poses and inverse depths by the least-squares loop; base of all solvers.

Depths are eliminated source by source (Schur complement), the remaining camera system is solved,
and the depths follow. Solvers differ in what they keep of linearised matches, and where.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import FlowTerm
from geogs.bundle.problem import BundleProblem, Problem, StreamedProblem, source_chunks
from geogs.bundle.projection import INVERSE_DEPTHS
from geogs.bundle.protocols import BundleOptions, BundleResult
from geogs.bundle.terms import BundleState
from geogs.geometry.least_squares import Step, minimise
from geogs.geometry.lie import move
from geogs.threads import thread_map, worker_count

P = TypeVar("P", bound=Problem)
A = TypeVar("A", bound=BundleProblem | StreamedProblem)
L = TypeVar("L")
R = TypeVar("R")


class SchurBundle(ABC, Generic[P, L]):
    """One adjustment; ``L``: type of a linearised problem."""

    def __init__(self, problem: P, options: BundleOptions) -> None:
        self.problem = problem
        self.options = options
        self.information = problem.known_before()
        """Information of every inverse depth at the last linearisation."""

    @abstractmethod
    def linearise(self, state: BundleState) -> L:
        """Return the camera system, and the data for the depth steps."""

    @abstractmethod
    def solve_cameras(self, linear: L, damping: float) -> Float[Tensor, "v"] | None:
        """Solve for steps of all poses, zero for fixed ones, then of shared unknowns; None if not
        finite."""

    @abstractmethod
    def depth_steps(
        self, state: BundleState, linear: L, step: Float[Tensor, "v"]
    ) -> Float[Tensor, "n p"]:
        """Return steps of the free inverse depths, given the step of all others."""

    @abstractmethod
    def flow_cost(self, state: BundleState) -> float:
        """Return the cost of the matches (twice their objective)."""

    def cost(self, state: BundleState, linear: L | None = None) -> float:
        """Return the cost (twice the objective), in variances of the measurements."""
        terms = sum(term.cost(state) for term in self.problem.depth_terms)
        terms += sum(term.cost(state) for term in self.problem.pose_terms)
        return self.flow_cost(state) + terms

    def step(self, state: BundleState, linear: L, damping: float) -> Step[BundleState] | None:
        """Compute the step of all unknowns; None where it is not finite."""
        step = self.solve_cameras(linear, damping)
        if step is None:
            return None
        delta = self.depth_steps(state, linear, step)
        if not bool(torch.isfinite(delta).all()):
            return None
        poses = 6 * len(state.T_cw)
        xi = step[:poses].reshape(-1, 6)
        T = torch.where(self.problem.free_pose[:, None, None], move(xi, state.T_cw), state.T_cw)
        d = stepped_depths(self.problem, state.inverse_depth + delta)
        block = None if state.block is None else state.block.moved(step[poses:])
        return Step(BundleState(T, d, block), float(xi.abs().max()))

    def adjusted(self) -> BundleResult:
        """Run the adjustment from the initial state."""
        o = self.options
        cost = self.cost if o.lowers_cost else None
        solution = minimise(self.problem.start, self.linearise, self.step, o.policy, cost)
        s = solution.state
        return BundleResult(s.T_cw, s.inverse_depth, self.information, solution.finite)


class FlowSchur(SchurBundle[A, L]):
    """One adjustment on the CPU, which linearises some edges at a time, several in parallel."""

    def __init__(self, problem: A, flow: FlowTerm, options: BundleOptions) -> None:
        super().__init__(problem, options)
        self.flow = flow
        self.chunks = source_chunks(problem.source, options.chunk)

    def by_parts(self, work: Callable[[BundleProblem], R]) -> Iterator[R]:
        """Yield results for some edges at a time, in order; a few of them are kept at a time."""
        group = 8 * worker_count()
        for start in range(0, len(self.chunks), group):
            chunks = self.chunks[start : start + group]
            yield from thread_map(lambda chunk: work(self.problem.part(chunk)), chunks)

    def flow_cost(self, state: BundleState) -> float:
        """Sum the cost of all parts, always in the same order."""
        return sum(self.by_parts(lambda part: self.flow.cost(part, state, self.options.huber)))


def stepped_depths(problem: Problem, moved: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Clamp free inverse depths after a step to their range; keep the problem's own elsewhere."""
    free = problem.free_depth[:, None].to(moved.device)
    return torch.where(free, moved.clamp(*INVERSE_DEPTHS), problem.inverse_depth)
