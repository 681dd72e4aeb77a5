"""Matches of two views against their essential matrix, and derivatives by differences."""

import numpy as np
import torch

from geogs.geometry.lie import so3_exp
from geogs.shutter.epipolar import RelativePose, relative_pose

TURN, MOVE = np.array([0.05, -0.1, 0.03]), np.array([0.6, 0.2, -0.1])
TRUE = RelativePose(so3_exp(torch.tensor(TURN)).numpy(), MOVE / np.linalg.norm(MOVE))


def views(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """x/z and y/z of 200 points in two views."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 7], (200, 3))
    both = points, points @ TRUE.R.T + MOVE
    first, second = (p[:, :2] / p[:, 2:] + rng.normal(0, noise, (200, 2)) for p in both)
    return first, second


def error(pose: RelativePose, a: np.ndarray, b: np.ndarray) -> float:
    """Sampson's error of one match."""
    x, y, z = pose.t
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose.R
    a, b = np.append(a, 1), np.append(b, 1)
    there, back = E @ a, E.T @ b
    return float(b @ there / np.sqrt(there[:2] @ there[:2] + back[:2] @ back[:2]))


def test_motion_of_exact_matches():
    pose = relative_pose(*views(0.0), 1e-3)
    np.testing.assert_allclose(pose.R, TRUE.R, atol=1e-4)
    np.testing.assert_allclose(pose.t, TRUE.t, atol=1e-3)
    assert np.abs(TRUE.errors(*views(0.0))).max() < 1e-12


def test_errors_one_by_one():
    first, second = views(2e-3)
    slow = [error(TRUE, a, b) for a, b in zip(first, second, strict=True)]
    np.testing.assert_allclose(TRUE.errors(first, second), slow, atol=1e-12)


def test_derivatives_agree_with_differences_where_matches_are_exact():
    """There the denominator, which is held, does not matter."""
    first, second = views(0.0)
    derivatives, small = TRUE.derivatives(first, second), 1e-6
    for k, unit in enumerate(small * np.eye(5)):
        ends = [TRUE.stepped(step).errors(first, second) for step in (unit, -unit)]
        np.testing.assert_allclose(derivatives[:, k], (ends[0] - ends[1]) / (2 * small), atol=1e-6)


def test_a_step_keeps_a_motion_a_motion():
    pose = TRUE.stepped(np.array([0.1, -0.2, 0.05, 0.3, -0.1]))
    np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(pose.t), 1.0)
    turn = so3_exp(torch.tensor([0.1, -0.2, 0.05])).double().numpy()
    np.testing.assert_allclose(pose.R, turn @ TRUE.R, atol=1e-7)
