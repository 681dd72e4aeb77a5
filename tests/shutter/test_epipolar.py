"""The motion between two views, from matches."""

import numpy as np
import torch

from geogs.geometry.lie import so3_exp
from geogs.shutter.epipolar import relative_pose

TURN, MOVE = np.array([0.05, -0.1, 0.03]), np.array([0.6, 0.2, -0.1])


def test_motion_of_exact_matches():
    R = so3_exp(torch.tensor(TURN)).numpy()
    points = np.random.default_rng(0).uniform([-2, -1.5, 3], [2, 1.5, 7], (200, 3))
    first, second = (p[:, :2] / p[:, 2:] for p in (points, points @ R.T + MOVE))
    pose = relative_pose(first, second, 1e-3)
    np.testing.assert_allclose(pose.R, R, atol=1e-4)
    np.testing.assert_allclose(pose.t, MOVE / np.linalg.norm(MOVE), atol=1e-3)
