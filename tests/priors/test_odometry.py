"""The scale between motions of the images and measured ones, and whether they fit at all."""

import math

import numpy as np
import pytest
import torch

from geogs.config import OdometryConfig
from geogs.geometry.lie import se3_inverse
from geogs.priors.odometry import information_of, vote_on_scale
from measured_poses import drifting
from tracking_scenes import pose, sideways

CONFIG = OdometryConfig()


def steps(T_cw: torch.Tensor) -> torch.Tensor:
    return T_cw[1:] @ se3_inverse(T_cw[:-1])


def seen(path: list[np.ndarray], unit: float) -> torch.Tensor:
    """Motions of a path, a unit being so many metres."""
    T = torch.from_numpy(np.linalg.inv(np.stack(path)))
    T[:, :3, 3] /= unit
    return steps(T)


def told(path: list[np.ndarray], **noise: float) -> torch.Tensor:
    return steps(torch.stack([p.T_cw for p in drifting(path, **noise)]))


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_scale_is_that_of_most_motions(wrong):
    path = sideways(30, 0.08)
    vote = vote_on_scale(seen(path, 2.3), told(path, seed=1, wrong=wrong), CONFIG)
    assert vote.scale == pytest.approx(2.3, rel=0.005)
    assert abs(vote.scale / 2.3 - 1) < 4 * vote.deviation
    assert vote.deviation < 0.01
    assert vote.fraction > (0.95 if wrong == 0 else 0.45)


def test_long_paths_try_some_scales_alone():
    path = sideways(600, 0.08)
    vote = vote_on_scale(seen(path, 2.3), told(path, seed=2, wrong=0.3), CONFIG)
    assert vote.scale == pytest.approx(2.3, rel=0.002)
    assert vote.fraction > 0.35


def test_poses_of_another_video_do_not_fit():
    path = sideways(30, 0.08)
    other = [pose(0.05 * np.cos(0.4 * k), 0.02 * k, 0.06 * k, 0.09 * k) for k in range(30)]
    vote = vote_on_scale(seen(path, 2.3), told(other), CONFIG)
    assert vote.fraction < 0.2


def test_a_camera_that_stays_tells_no_scale():
    path = [pose(0, yaw=0.05 * k) for k in range(10)]
    vote = vote_on_scale(seen(path, 1.0), told(path), CONFIG)
    assert vote.deviation == math.inf
    still = vote_on_scale(seen(sideways(10), 1.0), told(path), CONFIG)
    assert still.deviation > 0.1


def test_deviations_grow_with_the_distance():
    motion = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    motion[1, 0, 3] = 2.0
    deviation = 1 / information_of(motion, CONFIG).sqrt()
    expected = [0.003, math.radians(0.15), math.hypot(0.003, 0.02), math.radians(0.6185)]
    found = [deviation[0, 0], deviation[0, 5], deviation[1, 0], deviation[1, 3]]
    assert [float(x) for x in found] == pytest.approx(expected, rel=1e-3)
