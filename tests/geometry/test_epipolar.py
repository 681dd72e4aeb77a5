"""Distances from the epipolar geometry against the least move that obeys it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.geometry.epipolar import epipolar_distance, homogeneous, in_front_of_both


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


def test_a_twisted_pair_sees_behind_a_camera_though_on_its_epipolar_lines():
    """Depths against least squares of each match; the twisted pair turns half about the line."""
    random = np.random.default_rng(1)
    t = np.array([0.6, 0.1, -0.2])
    true = pose(Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), t)
    half = Rotation.from_rotvec(np.pi * t / np.linalg.norm(t)).as_matrix()
    points = random.uniform([-1, -1, 2], [1, 1, 5], (40, 3))
    moved = points @ true[:3, :3].T + t
    moved[30:, 2] *= random.uniform(0.2, 3.0, 10)  # false matches: any depths
    one, two = points / points[:, 2:], moved / moved[:, 2:]
    for T, is_true in ((true, True), (pose(half @ true[:3, :3], t), False)):
        assert epipolar_distance(T, np.eye(3), one, two)[:30].max() < 1e-9
        found = in_front_of_both(T, one, two, 1e-3)
        for a, b, in_front in zip(one, two, found, strict=True):
            rays = np.stack([T[:3, :3] @ a, -b], -1)
            depths = np.linalg.lstsq(rays, -t, rcond=None)[0]
            assert in_front == (depths > 0).all()
        assert (found[:30] == is_true).all()


def test_what_is_far_away_lies_in_front_whatever_the_noise():
    R = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    one = homogeneous(np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2)))
    two = one @ R.T
    two = two / two[:, 2:] + np.random.default_rng(1).uniform(-1e-3, 1e-3, (50, 3)) * [1, 1, 0]
    T = pose(R, np.array([1.0, 0.0, 0.0]))
    assert in_front_of_both(T, one, two, 2e-3).all()
    assert not in_front_of_both(T, one, two, 1e-6).all()
