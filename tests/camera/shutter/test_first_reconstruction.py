"""What an adjustment begins with, where all rows are seen at once."""

import numpy as np
import torch

from geogs.camera.shutter.first_reconstruction import (
    first_reconstruction,
    inverse_depths,
    relative_pose,
)
from geogs.geometry.lie import so3_exp
from row_by_row import FOCAL, clip_of, scattered, shaken

TURN, MOVE = np.array([0.05, -0.1, 0.03]), np.array([0.6, 0.2, -0.1])


def test_motion_of_exact_matches():
    R = so3_exp(torch.tensor(TURN)).numpy()
    points = np.random.default_rng(0).uniform([-2, -1.5, 3], [2, 1.5, 7], (200, 3))
    first, second = (p[:, :2] / p[:, 2:] for p in (points, points @ R.T + MOVE))
    rotation, direction = relative_pose(first, second, 1e-3)
    np.testing.assert_allclose(rotation, R, atol=1e-4)
    np.testing.assert_allclose(direction, MOVE / np.linalg.norm(MOVE), atol=1e-3)


def test_inverse_depths_of_exact_views():
    points, move = scattered(2), np.array([0.3, 0.1, 0.05])
    length = np.linalg.norm(move)
    first, second = (p[:, :2] / p[:, 2:] for p in (points, points + move))
    found = inverse_depths(np.eye(3), move / length, first, second)
    np.testing.assert_allclose(found, length / points[:, 2], rtol=1e-6)


def test_a_global_shutter_is_reconstructed_up_to_scale():
    tracks = clip_of(shaken(1), scattered(1), 0.0)
    found = first_reconstruction(tracks, 1.2 / FOCAL)
    error = np.linalg.norm(found.projected() - tracks.plane, axis=-1)[tracks.seen]
    assert np.median(error) * FOCAL < 0.3
    depth = 1 / found.points[:, 2]
    true = scattered(1)[:, 2]
    assert np.corrcoef(depth, true)[0, 1] > 0.9


def test_points_without_a_common_motion_are_nothing():
    tracks = clip_of(shaken(1), scattered(1), 0.0)
    mixed = np.random.default_rng(0).uniform(-0.5, 0.5, tracks.plane.shape)
    still = type(tracks)(mixed, tracks.line_times, tracks.seen, tracks.times)
    found = first_reconstruction(still, 1.2 / FOCAL)
    if found is not None:
        error = np.linalg.norm(found.projected() - mixed, axis=-1)[tracks.seen]
        assert np.median(error) * FOCAL > 10
