"""When a comparison of trajectories is doubted, and when not."""

import numpy as np
import pytest

from geogs.evaluation.doubts import doubts
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.types import Trajectory


def path(n: int = 50, seconds: float = 0.1, size: float = 2.0, width: float = 1.0) -> Trajectory:
    t = np.linspace(0, 5, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = size * np.sin(t)
    T[:, 1, 3], T[:, 2, 3] = width * size * np.cos(t), 0.3 * width * size * np.sin(3 * t)
    return Trajectory(seconds * np.arange(n), T, np.ones(n, bool))


def noisy(trajectory: Trajectory, noise: float, scale: float = 1.0) -> Trajectory:
    T = trajectory.T_wc.copy()
    T[:, :3, 3] = scale * (T[:, :3, 3] + np.random.default_rng(0).normal(size=(len(T), 3)) * noise)
    return Trajectory(trajectory.timestamps, T, trajectory.tracked)


def said(
    estimate: Trajectory, reference: Trajectory, alignment: str = "sim3", is_metric: bool = False
) -> list[str]:
    errors = evaluate_trajectory(estimate, reference, 0.02, alignment)
    return doubts(errors, estimate, reference, 0.02, is_metric)


def test_nothing_speaks_against_a_usual_comparison():
    assert said(noisy(path(), 0.01, 0.2), path()) == []
    every_third = Trajectory(*(x[::3] for x in (path().timestamps, path().T_wc, path().tracked)))
    assert said(noisy(path(), 0.01), every_third) == []  # a truth with fewer poses
    assert said(noisy(every_third, 0.01), path()) == []
    assert said(noisy(path(), 0.01), path(), is_metric=True) == []
    assert said(noisy(path(), 0.01), path(), "se3") == []


def test_few_poses_that_match_in_time():
    """50 frames at 5 Hz, and true poses that count 30 a second."""
    sentences = said(noisy(path(seconds=0.2), 0.01), path(seconds=1 / 30))
    assert any("Only 9 of 50 poses match in time" in s for s in sentences)
    some = Trajectory(*(x[::7] for x in (path().timestamps, path().T_wc, path().tracked)))
    [sentence] = said(noisy(path(), 0.01), some)
    assert "Only 8 of 50 estimated poses are compared" in sentence
    few = path(n=5)
    assert "5 poses are so few" in said(noisy(few, 0.01), few)[0]


def test_an_alignment_that_is_not_determined():
    assert "so straight" in said(noisy(path(width=0.001), 0.01), path(width=0.001))[0]
    [still] = said(noisy(path(size=0.001), 0.01), path(size=0.001))
    assert "hardly moved" in still


@pytest.mark.parametrize("alignment", ["sim3", "se3"])
def test_units_that_cannot_be(alignment):
    estimate = noisy(path(), 0.01, scale=0.01)  # says metres, is in hundreds of them
    sentences = said(estimate, path(), alignment, is_metric=True)
    assert any("as large as the estimated one" in s for s in sentences)
    millimetres = path(size=2000.0)
    assert any("metres a second" in s for s in said(noisy(millimetres, 1.0), millimetres))
