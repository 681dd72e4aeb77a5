"""The common least-squares loop: damped Gauss-Newton and Levenberg-Marquardt for any problem.

A problem is two functions, one that linearises it at a state and one that takes a damped step from
there; a policy controls the steps, the damping and the end. States and their arrays belong to the
problem: poses and depths, a lens, the points of a clip, on any device.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

S = TypeVar("S")
"""A state."""
L = TypeVar("L")
"""A problem linearised at a state."""


@dataclass(frozen=True)
class Step(Generic[S]):
    """Result of a step."""

    state: S
    size: float = math.inf
    """Largest change of the state; infinite if it is not used to stop."""


@dataclass(frozen=True)
class Policy:
    """Acceptance of steps, damping and stopping criteria.

    Without the fields of the second half, and without a cost: the Gauss-Newton method, with the
    same damping in all steps.
    """

    max_steps: int = sys.maxsize
    """Largest number of accepted steps."""
    damping: float = 0.0
    """Damping at the start."""
    tolerance: float = 0.0
    """Step size below which an accepted step is the last one."""

    max_trials: int = sys.maxsize
    """Largest number of steps tried, accepted or not."""
    max_damping: float = math.inf
    """Damping beyond which no step is tried."""
    least_damping: float = 0.0
    """Damping below which it does not fall."""
    least_raised: float = 0.0
    """Least damping from which it is raised."""
    retries_unsolvable: bool = False
    """Whether equations without a solution are damped more; otherwise they end the loop."""
    least_decrease: float = 0.0
    """Fraction of the cost; a step that lowers it by no more is the last one."""
    is_of_new_cost: bool = False
    """Whether that is a fraction of the cost after the step, not before it."""
    costs_anew: bool = False
    """Whether the active residuals depend on where the problem was linearised. Then the cost after
    a step is computed after linearising again."""
    enough: float = 0.0
    """Cost below which the loop ends."""
    stall: float = -math.inf
    """Relative rise of the cost up to which a rejected step ends the loop."""


@dataclass(frozen=True)
class Solution(Generic[S, L]):
    """Result of the loop."""

    state: S
    linear: L | None
    """The problem linearised at the state; None where that was not needed."""
    cost: float
    """Final cost; NaN without a cost function."""
    steps: int
    """Number of accepted steps."""
    finite: bool
    """Whether the last equations had a solution, if need be with more damping."""


def minimise(
    start: S,
    linearise: Callable[[S], L],
    step: Callable[[S, L, float], Step[S] | None],
    policy: Policy,
    cost: Callable[[S, L], float] | None = None,
) -> Solution[S, L]:
    """Minimise from a state on.

    Args:
        start: the initial state.
        linearise: returns the normal equations at a state.
        step: solves them with a damping; None where there is no finite solution.
        policy: steps, damping and end.
        cost: of a state, over the residuals active at the linearisation. With a cost only steps
            that lower it are accepted (Levenberg-Marquardt): damping falls tenfold with each of
            these and rises tenfold with each other. Without one all steps are accepted.
    """
    state = start
    damping = policy.damping
    linear: L | None = None
    before = after = math.nan
    steps = trials = 0
    finite = True
    while steps < policy.max_steps and trials < policy.max_trials and damping <= policy.max_damping:
        if linear is None:
            linear = linearise(state)
        if cost is not None and trials == 0:
            before = cost(state, linear)
        trials += 1
        found = step(state, linear, damping)
        finite = found is not None
        if not finite and not policy.retries_unsolvable:
            break
        if cost is not None:
            after = math.inf if found is None else cost(found.state, linear)
            if found is not None and not after < before and after - before <= policy.stall * before:
                break
        if found is None or (cost is not None and not after < before):
            damping = max(damping, policy.least_raised) * 10
            continue
        state = found.state
        linear = None
        steps = steps + 1
        is_last = found.size < policy.tolerance
        if cost is None:
            if is_last:
                break
            continue
        damping = max(damping / 10, policy.least_damping)
        gain = before - after
        if policy.costs_anew:
            linear = linearise(state)
            after = cost(state, linear)
        reference = after if policy.is_of_new_cost else before
        before = after
        if is_last or gain <= policy.least_decrease * reference or after < policy.enough:
            break
    return Solution(state, linear, before, steps, finite)
