"""The least-squares loop: which steps it takes, and when it ends."""

import math
from dataclasses import replace

import numpy as np
import pytest

from geogs.geometry.least_squares import Policy, Step, minimise

LEVENBERG = Policy(max_steps=200, damping=1e-3, max_damping=1e10, enough=1e-16)


def residuals(x: np.ndarray) -> np.ndarray:
    """Rosenbrock's valley: its bottom is at (1, 1)."""
    return np.array([1 - x[0], 10 * (x[1] - x[0] ** 2)])


def linearise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    J = np.array([[-1.0, 0.0], [-20 * x[0], 10.0]])
    return J.T @ J, -J.T @ residuals(x)


def step(x: np.ndarray, linear: tuple[np.ndarray, np.ndarray], damping: float) -> Step:
    H, g = linear
    xi = np.linalg.solve(H + damping * np.diag(H.diagonal()), g)
    return Step(x + xi, float(np.abs(xi).max()))


def cost(x: np.ndarray, linear: object) -> float:
    return float(residuals(x) @ residuals(x))


def test_every_step_of_levenberg_lowers_the_cost():
    seen = []

    def recorded(x, linear):
        seen.append(cost(x, linear))
        return seen[-1]

    found = minimise(np.array([-1.2, 1.0]), linearise, step, LEVENBERG, recorded)
    np.testing.assert_allclose(found.state, 1, atol=1e-6)
    assert found.finite
    assert found.cost < 1e-14
    taken = np.minimum.accumulate(seen)
    assert found.cost == taken[-1]
    assert len(seen) > found.steps + 1, "none was refused: the test says nothing"


def test_without_a_cost_every_step_is_taken_until_one_is_small():
    policy = Policy(max_steps=50, tolerance=1e-9)
    found = minimise(np.array([-1.2, 1.0]), linearise, step, policy)
    np.testing.assert_allclose(found.state, 1, atol=1e-9)
    assert found.steps < 10
    assert math.isnan(found.cost)
    assert minimise(np.array([-1.2, 1.0]), linearise, step, Policy(2)).steps == 2


@pytest.mark.parametrize("retries", [False, True])
def test_equations_without_a_solution_are_the_end_or_damped(retries):
    asked = []

    def unsolvable(x, linear, damping):
        asked.append(damping)
        return None if damping < 1 else step(x, linear, damping)

    policy = Policy(max_steps=1, damping=1e-3, max_damping=1e3, retries_unsolvable=retries)
    found = minimise(np.array([-1.2, 1.0]), linearise, unsolvable, policy, cost)
    assert found.finite == retries
    assert found.steps == int(retries)
    assert asked == pytest.approx([1e-3, 1e-2, 1e-1, 1.0] if retries else [1e-3])


def test_equations_that_never_have_a_solution_are_said_to_have_none():
    policy = Policy(max_steps=1, damping=1e-3, max_damping=1e3, retries_unsolvable=True)
    start = np.array([-1.2, 1.0])
    found = minimise(start, linearise, lambda *_: None, policy, cost)
    assert not found.finite
    assert found.steps == 0
    assert found.state is start


def test_a_small_step_is_the_last_one_that_lowers_the_cost():
    start = np.array([-1.2, 1.0])
    every = minimise(start, linearise, step, LEVENBERG, cost)
    sizes = []

    def seen(x, linear, damping):
        sizes.append(step(x, linear, damping))
        return sizes[-1]

    found = minimise(start, linearise, seen, replace(LEVENBERG, tolerance=0.05), cost)
    assert 0 < found.steps < every.steps
    assert sizes[-1].state is found.state
    assert sizes[-1].size < 0.05
    assert found.cost == cost(found.state, None) < cost(start, None)


def test_steps_that_are_refused_count_where_trials_do():
    policy = Policy(max_trials=3, damping=1e-3, max_damping=1e9, least_raised=1.0)
    asked = []

    def uphill(x, linear, damping):
        asked.append(damping)
        return Step(x + 1)

    found = minimise(np.ones(2), linearise, uphill, policy, cost)
    assert asked == [1e-3, 10.0, 100.0]
    assert found.steps == 0
    np.testing.assert_array_equal(found.state, 1)


def test_a_decrease_may_be_judged_by_the_cost_once_linearised_anew():
    """Residuals that begin to count with a step make the cost rise, and do not end the steps."""

    def anew(x, linear):
        return cost(x, linear) + (0.5 if linear[0][0, 0] < 100 else 0.0)

    policy = Policy(10, 1e-3, max_damping=1e9, costs_anew=True, is_of_new_cost=True, enough=1e-12)
    found = minimise(np.array([-1.2, 1.0]), linearise, step, policy, anew)
    assert found.linear is not None
    assert found.cost == anew(found.state, found.linear)
