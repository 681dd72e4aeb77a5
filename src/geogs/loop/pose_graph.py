"""Sim(3) pose-graph adjustment: relative poses and dense matches over drifting keyframes.

A monocular tracker drifts in scale, so every keyframe has a similarity ``S`` from the world to its
camera *in the keyframe's own unit of length*, lifted from its pose with scale 1. A relative pose G
from keyframe i to j measures S_j S_i^-1, with the error ``e = log(G S_i S_j^-1)`` in tangent order
[tau, phi, sigma], in the frame of j. Loops are robust: Geman-McClure, approached from the convex
side (graduated non-convexity, Yang et al. 2020), so that a false loop loses its weight instead of
deforming the map. Steps are Levenberg-Marquardt on left retractions, each solved sparsely; memory
is linear in edges. Source: the Sim(3) pose graph of HI-SLAM2, with exact Jacobians.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.bundle.projection import INVERSE_DEPTHS
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.lie import (
    retract,
    sim3_adjoint,
    sim3_inverse,
    sim3_inverse_jacobian,
    sim3_log,
    sim3_scale,
    sim3_small_adjoint,
)
from geogs.loop.block_system import BlockEquations, BlockSystem
from geogs.loop.matched_edges import GraphState, LinearMatches, MatchedEdges
from geogs.types import PoseCorrection
from geogs.world.loops import RelativePoses

LOOP_THRESHOLD = 37.0
"""Squared error, in squared standard deviations, at which a loop's influence fades: twice the 99th
percentile of chi^2 with seven degrees of freedom, so that most true loops keep most."""
DRIFT = 9.0
"""Factor on the covariance of trusted edges when there are loops. Odometry errors are correlated
from step to step, so the error of a chain is larger than its steps predict; without the factor true
loops would lose their weight."""
CONVEXITY_STEP = 4.0
"""Factor by which the kernel is narrowed from stage to stage."""
STEPS, STAGE_STEPS = 20, 2
"""Most steps of the last stage, and of every other."""
TOLERANCE = 1e-6
"""Relative decrease of the cost by a step at which a stage ends, and cost at which it ends, in
squared standard deviations."""
DAMPING, MAX_DAMPING = 1e-8, 1e4
"""Levenberg damping at the start, relative to the diagonal, and damping at which a stage ends if
the cost still does not fall."""


@dataclass(frozen=True)
class PoseGraph:
    """The adjustment problem."""

    start: Float[Tensor, "n 4 4"]
    """World to camera of each keyframe in its own unit, float64; at first simply its pose."""
    relative: RelativePoses
    fixed: Bool[Tensor, "n"]
    """Keyframes whose similarity is fixed; at least one, or the gauge is free."""
    matches: MatchedEdges | None = None
    is_metric: bool = False
    """Whether units do not drift, so that all scales are fixed."""


@dataclass(frozen=True, kw_only=True)
class PoseGraphResult(GraphState):
    """The adjusted graph, in each keyframe's unit of before."""

    loop_weight: Float[Tensor, "e"]
    """Robust weight of each relative pose, in [0, 1]; 1 for trusted ones."""


def relative_errors(S: Float[Tensor, "n 4 4"], relative: RelativePoses) -> Float[Tensor, "e 7"]:
    """Return ``log(G S_i S_j^-1)`` of every relative pose."""
    return sim3_log(relative.G @ S[relative.source] @ sim3_inverse(S[relative.target]))


def relative_jacobians(
    relative: RelativePoses, error: Float[Tensor, "e 7"]
) -> tuple[Float[Tensor, "e 7 7"], Float[Tensor, "e 7 7"]]:
    """Return the exact d error / d xi of source and target (left perturbations).

    A motion of the source acts on the error from the left through Ad(G), one of the target through
    Ad(Exp(e)): Jl(e)^-1 Ad(G) and -Jl(e)^-1 Ad(Exp(e)) = -Jr(e)^-1 = -(Jl(e)^-1 + ad(e)).
    """
    inverse = sim3_inverse_jacobian(error)
    return inverse @ sim3_adjoint(relative.G), -(inverse + sim3_small_adjoint(error))


def solve(graph: PoseGraph) -> PoseGraphResult:
    """Adjust all similarities, and the inverse depths of matched edges.

    The kernel starts so wide that it is convex over the errors of all loops at the given poses.
    Every step lowers the cost at its stage; the result is deterministic.
    """
    matches = graph.matches
    relative = RelativeTerm.of(graph.relative)
    others = [] if matches is None else [matches]
    depth = None if matches is None else matches.inverse_depth
    state = GraphState(graph.start.double(), depth)
    problem = _Problem(graph)
    for width in relative.widths(state):
        problem.terms = [relative.widened(width), *others]
        policy = Policy(
            max_steps=STEPS if width == 1.0 else STAGE_STEPS,
            damping=DAMPING,
            max_damping=MAX_DAMPING,
            least_damping=DAMPING,
            retries_unsolvable=True,
            least_decrease=TOLERANCE,
            is_of_new_cost=True,
            costs_anew=matches is not None,
            enough=TOLERANCE,
            stall=1e-12,
        )
        state = minimise(state, problem.linearise, problem.step, policy, _cost).state
    weights = relative.robust_weights(relative_errors(state.S, graph.relative))
    return PoseGraphResult(state.S, state.inverse_depth, loop_weight=weights)


def pose_correction(
    ids: Sequence[int], T_cw: Float[Tensor, "n 4 4"], S: Float[Tensor, "n 4 4"]
) -> PoseCorrection:
    """Return the correction for the rest of the system: T' = (R, t / s) and s of each keyframe.

    Lengths around a keyframe are divided by s, so inverse depth is multiplied by it, as
    ``KeyframeSet.correct`` does; the map follows by T'^-1 (1 / s) T = S^-1 T.
    """
    scale = sim3_scale(S)
    after = S / scale[:, None, None]
    after[:, 3] = S[:, 3]
    return PoseCorrection(
        {k: T_cw[n].clone() for n, k in enumerate(ids)},
        {k: after[n].clone() for n, k in enumerate(ids)},
        {k: float(scale[n]) for n, k in enumerate(ids)},
    )


@dataclass(frozen=True)
class RelativeTerm:
    """Term of relative poses; Geman-McClure kernel for loops."""

    relative: RelativePoses
    information: Float[Tensor, "e 7"]
    limit: float
    """Squared error at which a loop's influence fades."""

    @staticmethod
    def of(relative: RelativePoses) -> "RelativeTerm":
        """Return the term with the kernel of the last stage."""
        trust = 1 / DRIFT if bool(relative.is_loop.any()) else 1.0
        information = torch.where(
            relative.is_loop[:, None], relative.information, trust * relative.information
        )
        return RelativeTerm(relative, information, LOOP_THRESHOLD)

    def widened(self, width: float) -> "RelativeTerm":
        """Return the term with a kernel ``width`` times as wide."""
        return replace(self, limit=width * self.limit)

    def widths(self, state: GraphState) -> list[float]:
        """Return the factors on the kernel's limit from stage to stage; the last is 1."""
        widths = [1.0]
        square = self.squares(relative_errors(state.S, self.relative))[self.relative.is_loop]
        # Geman-McClure is convex up to a third of its squared threshold.
        widest = 3 * float(square.max()) / self.limit if len(square) else 0.0
        while widths[0] < widest:
            widths.insert(0, widths[0] * CONVEXITY_STEP)
        return widths

    def squares(self, error: Float[Tensor, "e 7"]) -> Float[Tensor, "e"]:
        """Return squared errors in squared standard deviations."""
        return (self.information * error.square()).sum(-1)

    def robust_weights(self, error: Float[Tensor, "e 7"]) -> Float[Tensor, "e"]:
        """Return the Geman-McClure weight (c^2 / (c^2 + |e|^2))^2 of loops, 1 of other edges."""
        weight = (self.limit / (self.limit + self.squares(error))).square()
        return torch.where(self.relative.is_loop, weight, torch.ones_like(weight))

    def linearise(self, state: GraphState) -> "LinearRelative":
        """Linearise the relative poses at a state."""
        return LinearRelative(self, state.S)


@dataclass(frozen=True)
class LinearRelative:
    """All relative poses at one state; they have no depths."""

    term: RelativeTerm
    S: Float[Tensor, "n 4 4"]

    def equations(self, damping: float) -> BlockEquations:
        """Return equations over the keyframes."""
        relative = self.term.relative
        e = relative_errors(self.S, relative)
        J_i, J_j = relative_jacobians(relative, e)
        W = self.term.information * self.term.robust_weights(e)[:, None]
        i, j = relative.source, relative.target
        WJ_i = W[..., None] * J_i
        WJ_j = W[..., None] * J_j
        r = (W * e)[..., None]
        cross = J_i.mT @ WJ_j
        gradient = torch.zeros(len(self.S), 7, dtype=torch.float64)
        gradient.index_add_(0, i, -(J_i.mT @ r)[..., 0])
        gradient.index_add_(0, j, -(J_j.mT @ r)[..., 0])
        blocks = torch.cat([J_i.mT @ WJ_i, J_j.mT @ WJ_j, cross, cross.mT])
        return BlockEquations(torch.cat([i, j, i, j]), torch.cat([i, j, j, i]), blocks, gradient)

    def cost(self, state: GraphState) -> float:
        """Return the sum of |e|^2 of trusted edges, and of c^2 |e|^2 / (c^2 + |e|^2) of loops."""
        term = self.term
        limit = self.term.limit
        square = term.squares(relative_errors(state.S, term.relative))
        robust = torch.where(term.relative.is_loop, limit * square / (limit + square), square)
        return float(robust.sum())


LinearTerm = LinearRelative | LinearMatches


def _cost(state: GraphState, linear: Sequence[LinearTerm]) -> float:
    """Return the sum over the terms."""
    return sum(term.cost(state) for term in linear)


class _Problem:
    """Interface of one graph to the least-squares loop; its terms change from stage to stage."""

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        self.terms: list[RelativeTerm | MatchedEdges] = []
        self._system: BlockSystem | None = None
        """Solver of the last step; the next has the same blocks."""

    def linearise(self, state: GraphState) -> list[LinearTerm]:
        """Linearise all terms."""
        return [term.linearise(state) for term in self.terms]

    def step(
        self, state: GraphState, linear: Sequence[LinearTerm], damping: float
    ) -> Step[GraphState] | None:
        """Compute the step of all similarities and depths; None where there is no solution."""
        parts = [term.equations(damping) for term in linear]
        if self.graph.is_metric:
            parts = [part.without_scale() for part in parts]
        xi = self._solve(parts, damping)
        if xi is None:
            return None
        S = torch.where(self.graph.fixed[:, None, None], state.S, retract(xi, state.S))
        d = state.inverse_depth
        if d is not None:
            matches = (term for term in linear if isinstance(term, LinearMatches))
            d = sum((term.depth_step(xi, damping) for term in matches), d).clamp(*INVERSE_DEPTHS)
        return Step(GraphState(S, d))

    def _solve(
        self, parts: Sequence[BlockEquations], damping: float
    ) -> Float[Tensor, "n 7"] | None:
        """Solve the damped sparse system over the free keyframes; None if it is singular."""
        free = ~self.graph.fixed
        n = int(free.sum())
        xi = torch.zeros(len(free), 7, dtype=torch.float64)
        if not n:
            return xi
        slot = torch.full((len(free),), -1, dtype=torch.long)
        slot[free] = torch.arange(n)
        row, column = (slot[torch.cat([getattr(p, k) for p in parts])] for k in ("row", "column"))
        if self._system is None or not self._system.is_of(row, column):
            self._system = BlockSystem(row, column, n)
        gradient = sum((p.gradient for p in parts), torch.zeros_like(xi))[free]
        found = self._system.solve(torch.cat([p.block for p in parts]), gradient, damping)
        if found is None:
            return None
        xi[free] = found
        return xi
