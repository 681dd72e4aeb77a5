"""The one least-squares loop: damped Gauss-Newton and Levenberg-Marquardt, whatever is adjusted.

A problem is two functions, one that linearises it at a state and one that takes a damped step from
there; a policy says which steps are taken, how the damping follows them, and when it is enough.
States and their arrays are the problem's own: poses and depths, a lens, the points of a clip, on
any device.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

S = TypeVar("S")
"""A state."""
L = TypeVar("L")
"""A problem linearised at one."""


@dataclass(frozen=True)
class Step(Generic[S]):
    """Where a step leads."""

    state: S
    size: float = math.inf
    """Largest move of the state; infinite where nothing is to end by it."""


@dataclass(frozen=True)
class Policy:
    """Which steps are taken, and when it is enough.

    Without the fields of the second half, and without a cost: Gauss and Newton's method, with the
    same damping in all steps.
    """

    max_steps: int = sys.maxsize
    """Steps that are taken at most."""
    damping: float = 0.0
    """At the start."""
    tolerance: float = 0.0
    """A step of a smaller size that is taken is the last one."""

    max_trials: int = sys.maxsize
    """Steps that are tried at most, taken or not."""
    max_damping: float = math.inf
    """Damping beyond which no step is tried."""
    least_damping: float = 0.0
    """Damping below which it does not fall."""
    least_raised: float = 0.0
    """Damping from which it rises at least."""
    retries_unsolvable: bool = False
    """Whether equations without a solution are damped more; otherwise they are the end."""
    least_decrease: float = 0.0
    """Fraction of the cost; a step that lowers it by no more is the last one."""
    is_of_new_cost: bool = False
    """Whether that is a fraction of the cost after the step, not before it."""
    costs_anew: bool = False
    """Whether the residuals that count depend on where the problem was linearised. Then the cost
    after a step is what it is once that is done anew."""
    enough: float = 0.0
    """Cost below which there is nothing left to gain."""
    stall: float = -math.inf
    """Nor is there if a step raises the cost by no more than this fraction."""


@dataclass(frozen=True)
class Solution(Generic[S, L]):
    """Where the loop ended."""

    state: S
    linear: L | None
    """The problem linearised at the state; None where that was not needed."""
    cost: float
    """Not a number without one."""
    steps: int
    """Taken."""
    finite: bool
    """Whether the last equations had a solution, or were damped until they had."""


def minimise(
    start: S,
    linearise: Callable[[S], L],
    step: Callable[[S, L, float], Step[S] | None],
    policy: Policy,
    cost: Callable[[S, L], float] | None = None,
) -> Solution[S, L]:
    """Take steps from a state on.

    Args:
        start: the state.
        linearise: gives the normal equations at a state.
        step: gives the solution of these with a damping; None where there is no finite one.
        policy: which steps are taken.
        cost: of a state, over the residuals that count where the problem was linearised. With one
            only steps that lower it are taken (Levenberg and Marquardt): damping falls tenfold with
            each of these and rises tenfold with each other. Without one all are taken.
    """
    state, damping = start, policy.damping
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
        state, linear, steps = found.state, None, steps + 1
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
