"""Relative rotations against a loop, and which rotations count."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from geogs.evaluation.rotation_errors import relative_rotation_error, stretches
from geogs.evaluation.trajectory_errors import MAX_ROLL, evaluate_trajectory
from geogs.geometry.lie import so3_exp
from geogs.types import Trajectory


def street(sway: float, noise: float, seed: int = 0) -> tuple[Trajectory, Trajectory]:
    """A drive of 40 m along x that sways by so much, and an estimate with errors of its places."""
    random, n = np.random.default_rng(seed), 200
    t = torch.linspace(0, 1, n, dtype=torch.float64)
    truth = np.tile(np.eye(4), (n, 1, 1))
    truth[:, :3, :3] = so3_exp(torch.stack([0 * t, 0.3 * (9 * t).sin(), 0.1 * t], -1)).numpy()
    truth[:, 0, 3] = 40 * t
    truth[:, 1, 3], truth[:, 2, 3] = sway * (7 * t).sin(), sway * (11 * t).cos()
    found = truth.copy()
    found[:, :3, 3] += random.normal(size=(n, 3)).cumsum(0) * noise
    found[:, :3, :3] = (
        found[:, :3, :3] @ so3_exp(torch.tensor(random.normal(size=(n, 3)) * 2e-3)).numpy()
    )
    found[:, :3, 3] *= 0.3
    return (Trajectory(0.1 * np.arange(n), T, np.ones(n, bool)) for T in (truth, found))


def angle(R: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def test_relative_rotations_are_those_of_a_loop_over_all_poses():
    truth, found = street(2.0, 0.01)
    errors = evaluate_trajectory(found, truth)
    places, expected = truth.T_wc[:, :3, 3], {}
    steps = [0.0, *(np.linalg.norm(b - a) for a, b in pairwise(places))]
    length = 0.1 * sum(steps)
    for i in range(len(places)):
        for j in range(i, len(places)):
            if sum(steps[i + 1 : j + 1]) >= length:
                true = truth.T_wc[i, :3, :3].T @ truth.T_wc[j, :3, :3]
                said = found.T_wc[i, :3, :3].T @ found.T_wc[j, :3, :3]
                expected[i] = angle(true.T @ said)
                break
    is_there = np.isfinite(errors.relative_rotation_error)
    assert np.flatnonzero(is_there).tolist() == list(expected)
    np.testing.assert_allclose(
        errors.relative_rotation_error[is_there], list(expected.values()), atol=1e-6
    )
    rmse = np.sqrt(np.mean(np.square(list(expected.values()))))
    assert errors.relative_rotation_rmse_deg == pytest.approx(rmse)
    assert errors.stretch_m == pytest.approx(length)


def test_stretches_begin_only_where_the_way_is_long_enough():
    first, last = stretches(np.array([0.0, 1, 1, 2, 3.5]), 2.0)
    assert first.tolist() == [0, 1, 2]
    assert last.tolist() == [3, 4, 4]


def test_a_turned_world_changes_no_relative_rotation():
    truth, found = street(2.0, 0.0)
    world = so3_exp(torch.tensor([1.0, -0.4, 2.0], dtype=torch.float64)).numpy()
    R = found.T_wc[:, :3, :3]
    every, later = np.arange(150), np.arange(150) + 50
    one = relative_rotation_error(R, truth.T_wc[:, :3, :3], every, later)
    other = relative_rotation_error(world @ R, truth.T_wc[:, :3, :3], every, later)
    np.testing.assert_allclose(one, other, atol=1e-9)
    assert 0.05 < np.sqrt((one**2).mean()) < 0.6  # 2 mrad each, twice, three axes: 0.28 degrees


def test_along_a_straight_street_relative_rotations_count_and_in_a_room_absolute_ones():
    truth, found = street(0.02, 0.01)
    straight = evaluate_trajectory(found, truth)
    which, error, rmse = straight.rotations
    assert which == "relative"
    assert straight.roll_deg > MAX_ROLL
    assert straight.rotation_rmse_deg > 5 > 1 > rmse > 0.1
    assert np.sqrt(np.nanmean(error**2)) == pytest.approx(rmse)
    truth, found = street(4.0, 0.001)
    wide = evaluate_trajectory(found, truth)
    assert wide.rotations[0] == "absolute"
    assert wide.rotations[2] == wide.rotation_rmse_deg < 0.5
