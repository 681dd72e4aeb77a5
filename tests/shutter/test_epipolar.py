"""Matches of two views against their essential matrix, by single steps and by brute force."""

import numpy as np
import torch

from geogs.geometry.lie import so3_exp
from geogs.shutter.epipolar import refined_costs, relative_pose

TOLERANCE = 1e-3
TURN, MOVE = np.array([0.05, -0.1, 0.03]), np.array([0.6, 0.2, -0.1])


def views(noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays towards 200 points in two views."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 7], (200, 3))
    second = points @ so3_exp(torch.tensor(TURN)).numpy().T + MOVE
    rays = []
    for seen in (points, second):
        plane = seen[:, :2] / seen[:, 2:] + rng.normal(0, noise, (200, 2))
        ray = np.concatenate([plane, np.ones((200, 1))], 1)
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    return rays[0], rays[1]


def cost(R: np.ndarray, t: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """The mean of the matches' costs, one by one."""
    x, y, z = t
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    total = 0.0
    for a, b in zip(first / first[:, 2:], second / second[:, 2:], strict=True):
        there, back = E @ a, E.T @ b
        square = (b @ there) ** 2 / (there[:2] @ there[:2] + back[:2] @ back[:2]) / TOLERANCE**2
        total += square / (1 + square)
    return total / len(first)


def test_motion_and_cost_of_exact_matches():
    first, second = views(0.0)
    pose = relative_pose(first, second, TOLERANCE)
    np.testing.assert_allclose(pose.R, so3_exp(torch.tensor(TURN)).numpy(), atol=1e-4)
    np.testing.assert_allclose(pose.t, MOVE / np.linalg.norm(MOVE), atol=1e-3)
    assert refined_costs(pose, first[None], second[None], TOLERANCE)[0] < 1e-6


def test_steps_end_in_the_minimum():
    """No small change of the motion has a lower cost than the one that the steps came to."""
    first, second = views(0.4e-3)
    pose = relative_pose(first, second, TOLERANCE)
    (least,) = refined_costs(pose, first[None], second[None], TOLERANCE)
    assert least <= cost(pose.R, pose.t, first, second)
    true = cost(so3_exp(torch.tensor(TURN)).numpy(), MOVE, first, second)
    assert least < true
    assert least > 0.9 * true  # five numbers cannot explain the noise of 200 matches


def test_versions_do_not_touch_each_other_and_outliers_count_once():
    first, second = views(0.4e-3)
    wrong = second.copy()
    wrong[:40] = wrong[:40][::-1]
    pose = relative_pose(first, second, TOLERANCE)
    both = refined_costs(pose, np.stack([first] * 2), np.stack([second, wrong]), TOLERANCE)
    alone = refined_costs(pose, first[None], wrong[None], TOLERANCE)
    np.testing.assert_allclose(both[1], alone[0], rtol=1e-9)
    assert both[0] + 0.1 < both[1] < both[0] + 0.2
