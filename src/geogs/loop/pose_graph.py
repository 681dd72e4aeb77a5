"""Sim(3) pose-graph adjustment: relative poses and dense matches over drifting keyframes.

A monocular tracker drifts in scale, so every keyframe carries a similarity ``S`` from the world to
its camera *in the keyframe's own unit of length*, lifted from its pose with scale 1. A relative
pose G from keyframe i to j says S_j S_i^-1 = G, and errs by ``e = log(G S_i S_j^-1)`` in tangent
order [tau, phi, sigma], in the frame of j. Loops are robust: Geman-McClure, approached from the
convex side (graduated non-convexity, Yang et al. 2020), so that a false loop loses its weight
instead of bending the map. Steps are Levenberg-Marquardt on left retractions, each solved sparsely;
memory is linear in edges. Source: the Sim(3) pose graph of HI-SLAM2, with exact Jacobians.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.lie import (
    retract,
    sim3_adjoint,
    sim3_inverse,
    sim3_inverse_jacobian,
    sim3_log,
    sim3_scale,
    sim3_small_adjoint,
)
from geogs.loop.block_system import BlockSystem
from geogs.loop.matched_edges import (
    BlockEquations,
    LinearMatches,
    MatchedEdges,
    MatchOptions,
    depth_step,
    linearise_matches,
    match_cost,
)
from geogs.types import PoseCorrection
from geogs.world.loops import RelativePoses


@dataclass(frozen=True)
class PoseGraph:
    """What is adjusted."""

    start: Float[Tensor, "n 4 4"]
    """World to camera of each keyframe in its own unit, float64; at first simply its pose."""
    relative: RelativePoses
    fixed: Bool[Tensor, "n"]
    """Keyframes whose similarity stays; at least one, or the world is undetermined."""
    matches: MatchedEdges | None = None
    is_metric: bool = False
    """Whether no unit drifts, so that all scales stay what they are at the start."""


@dataclass(frozen=True)
class PoseGraphOptions:
    """How a graph is adjusted."""

    loop_threshold: float = 37.0
    """Squared error, in squared standard deviations, at which a loop's influence fades: twice the
    99th percentile of chi^2 with seven degrees of freedom, so that most true loops keep most."""
    drift: float = 9.0
    """Factor of the covariance of trusted edges when there are loops. Odometry errs alike from step
    to step, and what a whole chain errs is more than its steps tell; a true loop would lose to
    it."""
    convexity_step: float = 4.0
    """Factor by which the kernel is sharpened from stage to stage."""
    stage_iterations: int = 2
    """Most steps of every other stage."""
    iterations: int = 20
    """Most steps of the last stage."""
    tolerance: float = 1e-6
    """A stage ends when a step lowers the cost by no more than this fraction of it, or when less
    than this is left, in squared standard deviations."""
    damping: float = 1e-8
    """Levenberg damping at the start, relative to the diagonal."""
    max_damping: float = 1e4
    """A stage ends when even this damping brings no decrease."""
    matches: MatchOptions = field(default_factory=MatchOptions)


@dataclass(frozen=True)
class PoseGraphResult:
    """The adjusted graph."""

    S: Float[Tensor, "n 4 4"]
    """World to camera in the keyframe's unit of before, float64."""
    inverse_depth: Float[Tensor, "n p"] | None
    """In the keyframe's unit of before; None without matches."""
    loop_weight: Float[Tensor, "e"]
    """Share of each relative pose that the kernel left in force, in [0, 1]; 1 for trusted ones."""
    cost_before: float
    """With the kernel of the last stage."""
    cost_after: float
    steps: int
    """Steps taken."""

    @property
    def scale(self) -> Float[Tensor, "n"]:
        """Unit of length of the world over the keyframe's unit of before."""
        return sim3_scale(self.S)


@dataclass(frozen=True)
class _State:
    S: Float[Tensor, "n 4 4"]
    inverse_depth: Tensor


def relative_errors(S: Float[Tensor, "n 4 4"], relative: RelativePoses) -> Float[Tensor, "e 7"]:
    """``log(G S_i S_j^-1)`` of every relative pose."""
    return sim3_log(relative.G @ S[relative.source] @ sim3_inverse(S[relative.target]))


def relative_jacobians(
    relative: RelativePoses, error: Float[Tensor, "e 7"]
) -> tuple[Float[Tensor, "e 7 7"], Float[Tensor, "e 7 7"]]:
    """d error / d xi of source and target (left perturbations), exact.

    A motion of the source reaches the error's left through Ad(G), one of the target through
    Ad(Exp(e)): Jl(e)^-1 Ad(G) and -Jl(e)^-1 Ad(Exp(e)) = -Jr(e)^-1 = -(Jl(e)^-1 + ad(e)).
    """
    inverse = sim3_inverse_jacobian(error)
    return inverse @ sim3_adjoint(relative.G), -(inverse + sim3_small_adjoint(error))


def solve(graph: PoseGraph, options: PoseGraphOptions | None = None) -> PoseGraphResult:
    """Adjust all similarities; inverse depths of matched edges with them.

    The kernel starts so wide that it is convex over the errors of all loops at the given poses.
    Every step lowers the cost at its stage; the result is deterministic.
    """
    options = options or PoseGraphOptions()
    none = torch.zeros(len(graph.start), 0)
    depth = none if graph.matches is None else graph.matches.inverse_depth
    start = _State(graph.start.double(), depth)
    problem = _Problem(graph, options)
    state, steps = start, 0
    for width in problem.widths(start):
        last = width == 1.0
        state, taken = problem.descend(
            state, width, options.iterations if last else options.stage_iterations
        )
        steps += taken
    valid = problem.linearise(state, 0.0).valid
    return PoseGraphResult(
        state.S,
        None if graph.matches is None else state.inverse_depth,
        problem.weights(relative_errors(state.S, graph.relative), 1.0),
        problem.cost(start, 1.0, valid),
        problem.cost(state, 1.0, valid),
        steps,
    )


def pose_correction(
    ids: Sequence[int], T_cw: Float[Tensor, "n 4 4"], S: Float[Tensor, "n 4 4"]
) -> PoseCorrection:
    """What the rest of the system needs to know: T' = (R, t / s) and s of each keyframe.

    Lengths around a keyframe are divided by s, so inverse depth is multiplied by it, as
    ``Tracker.correct`` does; the map follows by T'^-1 (1 / s) T = S^-1 T.
    """
    scale = sim3_scale(S)
    after = S / scale[:, None, None]
    after[:, 3] = S[:, 3]
    return PoseCorrection(
        {k: T_cw[n].clone() for n, k in enumerate(ids)},
        {k: after[n].clone() for n, k in enumerate(ids)},
        {k: float(scale[n]) for n, k in enumerate(ids)},
    )


class _Problem:
    """Cost, weights and steps of one graph."""

    def __init__(self, graph: PoseGraph, options: PoseGraphOptions) -> None:
        self.graph, self.options = graph, options
        self._system: BlockSystem | None = None
        """Of the last step; the next has the same blocks."""
        relative = graph.relative
        trust = 1 / options.drift if bool(relative.is_loop.any()) else 1.0
        self._information = torch.where(
            relative.is_loop[:, None], relative.information, trust * relative.information
        )

    def widths(self, state: _State) -> list[float]:
        """Widening of the kernel's threshold from stage to stage; the last is 1."""
        relative, widths = self.graph.relative, [1.0]
        square = self._squares(relative_errors(state.S, relative))[relative.is_loop]
        # Geman-McClure is convex up to a third of its squared threshold.
        widest = 3 * float(square.max()) / self.options.loop_threshold if len(square) else 0.0
        while widths[0] < widest:
            widths.insert(0, widths[0] * self.options.convexity_step)
        return widths

    def weights(self, error: Float[Tensor, "e 7"], width: float) -> Float[Tensor, "e"]:
        """Geman-McClure's factor (c^2 / (c^2 + |e|^2))^2 of loops, 1 of other edges."""
        limit = width * self.options.loop_threshold
        weight = (limit / (limit + self._squares(error))).square()
        return torch.where(self.graph.relative.is_loop, weight, torch.ones_like(weight))

    def cost(self, state: _State, width: float, valid: Bool[Tensor, "e p"]) -> float:
        """Sum of |e|^2 of trusted edges, c^2 |e|^2 / (c^2 + |e|^2) of loops, Huber of matches."""
        relative, limit = self.graph.relative, width * self.options.loop_threshold
        square = self._squares(relative_errors(state.S, relative))
        robust = torch.where(relative.is_loop, limit * square / (limit + square), square)
        total = float(robust.sum())
        if self.graph.matches is None:
            return total
        return total + match_cost(
            self.graph.matches, state.S, state.inverse_depth, valid, self.options.matches
        )

    def descend(self, state: _State, width: float, iterations: int) -> tuple[_State, int]:
        """Levenberg-Marquardt with one kernel; the new state and how many steps it took."""
        damping, steps = self.options.damping, 0
        linear = self.linearise(state, damping)
        cost = self.cost(state, width, linear.valid)
        while steps < iterations and damping <= self.options.max_damping:
            candidate = self._step(state, width, linear, damping)
            lowered = torch.inf if candidate is None else self.cost(candidate, width, linear.valid)
            if candidate is None or not lowered < cost:
                if candidate is not None and lowered - cost <= 1e-12 * cost:
                    break
                damping *= 10
                linear = self.linearise(state, damping)
                continue
            gain = cost - lowered
            state, steps = candidate, steps + 1
            damping = max(damping / 10, self.options.damping)
            linear = self.linearise(state, damping)
            # Which matches are valid has changed with the state; without any nothing has.
            cost = lowered if self.graph.matches is None else self.cost(state, width, linear.valid)
            if gain <= self.options.tolerance * cost or cost < self.options.tolerance:
                break
        return state, steps

    def linearise(self, state: _State, damping: float) -> LinearMatches:
        """The matched edges at a state, their depths eliminated; nothing without any."""
        if self.graph.matches is None:
            index = torch.zeros(0, dtype=torch.long)
            gradient = torch.zeros(len(state.S), 7, dtype=torch.float64)
            none = BlockEquations(index, index, gradient.new_zeros(0, 7, 7), gradient)
            return LinearMatches(none, (), torch.zeros(0, 0, dtype=torch.bool))
        return linearise_matches(
            self.graph.matches, state.S, state.inverse_depth, damping, self.options.matches
        )

    def _squares(self, error: Float[Tensor, "e 7"]) -> Float[Tensor, "e"]:
        return (self._information * error.square()).sum(-1)

    def _step(
        self, state: _State, width: float, linear: LinearMatches, damping: float
    ) -> _State | None:
        """The state one damped step on; None where the system cannot be solved."""
        parts = [self._relative_equations(state, width), linear.equations]
        if self.graph.is_metric:
            parts = [_without_scale(part) for part in parts]
        xi = self._solve(parts, damping)
        if xi is None:
            return None
        S = torch.where(self.graph.fixed[:, None, None], state.S, retract(xi, state.S))
        matches, limits = self.graph.matches, self.options.matches
        if matches is None:
            return _State(S, state.inverse_depth)
        d = state.inverse_depth + depth_step(linear, xi, state.inverse_depth)
        return _State(S, d.clamp(limits.min_inverse_depth, limits.max_inverse_depth))

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

    def _relative_equations(self, state: _State, width: float) -> BlockEquations:
        relative = self.graph.relative
        e = relative_errors(state.S, relative)
        J_i, J_j = relative_jacobians(relative, e)
        W = self._information * self.weights(e, width)[:, None]
        i, j = relative.source, relative.target
        WJ_i, WJ_j, r = W[..., None] * J_i, W[..., None] * J_j, (W * e)[..., None]
        cross = J_i.mT @ WJ_j
        gradient = torch.zeros(len(state.S), 7, dtype=torch.float64)
        gradient.index_add_(0, i, -(J_i.mT @ r)[..., 0])
        gradient.index_add_(0, j, -(J_j.mT @ r)[..., 0])
        blocks = torch.cat([J_i.mT @ WJ_i, J_j.mT @ WJ_j, cross, cross.mT])
        return BlockEquations(torch.cat([i, j, i, j]), torch.cat([i, j, j, i]), blocks, gradient)


def _without_scale(part: BlockEquations) -> BlockEquations:
    """The same equations with nothing that moves a scale."""
    rigid = torch.ones(7, dtype=torch.float64)
    rigid[6] = 0
    return replace(part, block=part.block * rigid[:, None] * rigid, gradient=part.gradient * rigid)
