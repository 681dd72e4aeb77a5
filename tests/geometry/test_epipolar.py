"""Distances from the epipolar geometry against the least move that obeys it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.geometry.epipolar import epipolar_distance, homogeneous


def pose(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def test_the_distance_of_matches_is_to_first_order_how_far_they_move():
    """Against the least move of both points of a match, by Newton's method on the constraint."""
    random = np.random.default_rng(0)
    R, t = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([0.3, 0.1, -0.2])
    points = random.uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    moved = points @ R.T + t
    first = points[:, :2] / points[:, 2:]
    second = moved[:, :2] / moved[:, 2:] + random.normal(scale=1e-3, size=(20, 2))
    E = np.cross(np.eye(3), t).T @ R
    distances = epipolar_distance(pose(R, t), np.eye(3), homogeneous(first), homogeneous(second))
    for x, y, found in zip(first, second, distances, strict=True):
        four = np.concatenate([x, y])
        for _ in range(20):
            a, b = np.append(four[:2], 1), np.append(four[2:], 1)
            slope = np.concatenate([(E.T @ b)[:2], (E @ a)[:2]])
            off = b @ E @ a + slope @ (np.concatenate([x, y]) - four)
            four = np.concatenate([x, y]) - off * slope / (slope @ slope)
        assert found == pytest.approx(np.linalg.norm(four - np.concatenate([x, y])), rel=0.02)


def test_cameras_in_one_place_are_told_by_the_rotation():
    R = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    ray = R @ np.array([0.1, 0.2, 1.0])
    second = ray[:2] / ray[2] + np.array([0.01, 0.0])
    one, two = homogeneous(np.array([[0.1, 0.2]])), homogeneous(second[None])
    off = epipolar_distance(pose(R, np.zeros(3)), np.eye(3), one, two)
    assert off == pytest.approx(0.01)
