"""Deviations against random poses that are aligned one by one."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geogs.geometry.umeyama import umeyama
from geogs_photos.deviations import without_gauge


def test_against_samples_that_are_aligned():
    random = np.random.default_rng(0)
    count = 6
    T_cw = np.tile(np.eye(4), (count, 1, 1))
    T_cw[:, :3, :3] = Rotation.random(count, rng=random).as_matrix()
    T_cw[:, :3, 3] = random.normal(size=(count, 3))
    root = 1e-4 * random.normal(size=(6 * count, 6 * count))
    place, _ = without_gauge(root @ root.T, T_cw)
    centres = -np.einsum("nij,ni->nj", T_cw[:, :3, :3], T_cw[:, :3, 3])
    squares = np.zeros(count)
    for _ in range(400):
        x = (root @ random.normal(size=6 * count)).reshape(count, 6)
        R = Rotation.from_rotvec(x[:, :3]).as_matrix() @ T_cw[:, :3, :3]
        moved = -np.einsum("nij,ni->nj", R, T_cw[:, :3, 3] + x[:, 3:])
        pair = map(torch.from_numpy, (moved, centres))
        scale, turn, shift = (v.numpy() for v in umeyama(*pair))
        squares += ((scale * moved @ turn.T + shift - centres) ** 2).sum(1)
    assert place == pytest.approx(np.sqrt(squares / 400), rel=0.15)


def test_what_hangs_on_at_an_end_sways_with_what_it_hangs_on():
    """Six cameras of which four are fitted: the others turn and grow with these."""
    random = np.random.default_rng(2)
    T_cw = np.tile(np.eye(4), (6, 1, 1))
    T_cw[:, :3, 3] = random.normal(size=(6, 3))
    T_cw[4:, :3, 3] += 10.0
    root = 1e-4 * random.normal(size=(36, 36))
    root[24:] = 0  # nothing is unsure about the last two but for the world of the others
    fitted = np.arange(6) < 4
    place, _ = without_gauge(root @ root.T, T_cw, fitted)
    centres, squares = -T_cw[:, :3, 3], np.zeros(6)
    for _ in range(400):
        x = (root @ random.normal(size=36)).reshape(6, 6)
        R = Rotation.from_rotvec(x[:, :3]).as_matrix()
        moved = -np.einsum("nij,ni->nj", R, T_cw[:, :3, 3] + x[:, 3:])
        pair = (torch.from_numpy(c[fitted]) for c in (moved, centres))
        scale, turn, shift = (v.numpy() for v in umeyama(*pair))
        squares += ((scale * moved @ turn.T + shift - centres) ** 2).sum(1)
    assert place == pytest.approx(np.sqrt(squares / 400), rel=0.15)
    assert place[4:].min() > place[:4].max()


def test_a_similarity_of_the_world_is_no_deviation():
    T_cw = np.tile(np.eye(4), (4, 1, 1))
    T_cw[:, :3, 3] = np.random.default_rng(1).normal(size=(4, 3))
    # dt = -R d moves every centre by d.
    common = np.tile([0, 0, 0, 1.0, 2.0, 3.0], 4)
    place, turn = without_gauge(np.outer(common, common), T_cw)
    assert place.max() < 1e-6
    assert turn.max() < 1e-6


def bearings(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where every camera sees every point, at depth 1."""
    seen = np.einsum("nij,kj->nki", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    return (seen[..., :2] / seen[..., 2:]).reshape(-1)


def moved_by(T_cw: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Poses whose left tangents, rotation then translation, are ``x``."""
    moved = T_cw.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(x[:, :3]).as_matrix() @ T_cw[:, :3, :3]
    moved[:, :3, 3] = T_cw[:, :3, 3] + x[:, 3:]
    return moved


@pytest.mark.parametrize("told", [(1e-4, 2e-5), (4e-3, 1e-3), (np.inf, np.inf)])
def test_what_was_known_before_against_adjustments_of_samples(told):
    """Eight cameras along a wall, of which the last three were not placed before: each sample has
    its own noise in the matches and in the poses told, is adjusted by dense least squares over
    poses and points, and laid over the truth by the first five."""
    random = np.random.default_rng(5)
    count, sigma, fitted = 8, 1e-3, np.arange(8) < 5
    T_cw = np.tile(np.eye(4), (count, 1, 1))
    T_cw[:, :3, :3] = Rotation.from_rotvec(0.05 * random.normal(size=(count, 3))).as_matrix()
    T_cw[:, :3, 3] = -np.stack([0.1 * np.arange(count), *0.05 * random.normal(size=(2, count))], 1)
    points = random.uniform((-2, -1, 3), (3, 1, 5), (25, 3))
    size = 6 * count + points.size

    def seen(x: np.ndarray) -> np.ndarray:
        moved = moved_by(T_cw, x[: 6 * count].reshape(count, 6))
        return bearings(moved, points + x[6 * count :].reshape(-1, 3))

    J = np.stack([seen(1e-6 * e) - seen(-1e-6 * e) for e in np.eye(size)], 1) / 2e-6
    A = J.T @ J / sigma**2
    free = np.setdiff1d(np.arange(size), 6 * count + np.array([0, 1, 2, 3, 4, 5, 8]))
    fixed = np.zeros((size, size))  # the gauge by two points and the depth of a third
    fixed[np.ix_(free, free)] = np.linalg.inv(A[np.ix_(free, free)])
    deviations = np.where(fitted, np.array(told)[:, None], np.inf)
    place, turn = without_gauge(fixed[: 6 * count, : 6 * count], T_cw, fitted, deviations)

    # Centre and axes of a camera in the world, by its tangents: the rows that were told.
    def world(x: np.ndarray) -> np.ndarray:
        moved = moved_by(T_cw, x[: 6 * count].reshape(count, 6))
        centres = -np.einsum("nij,ni->nj", moved[:, :3, :3], moved[:, :3, 3])
        turns = moved[:, :3, :3].transpose(0, 2, 1) @ T_cw[:, :3, :3]
        axes = -Rotation.from_matrix(turns).as_rotvec()
        return np.concatenate([centres[fitted].reshape(-1), axes[fitted].reshape(-1)])

    W = np.stack([world(1e-6 * e) - world(-1e-6 * e) for e in np.eye(size)], 1) / 2e-6
    spread = np.repeat(told, 3 * fitted.sum()) / np.sqrt(3)
    weight = 1 / spread**2
    solver = np.linalg.pinv(A + W.T @ (weight[:, None] * W), rcond=1e-13, hermitian=True)
    truth = -np.einsum("nij,ni->nj", T_cw[:, :3, :3], T_cw[:, :3, 3])
    squares, turned, samples = np.zeros(count), np.zeros(count), 600
    for _ in range(samples):
        noise = sigma * random.normal(size=len(J))
        off = np.where(np.isfinite(spread), spread, 0) * random.normal(size=len(spread))
        x = 0.01 * solver @ (J.T @ noise / sigma**2 + W.T @ (weight * off))
        poses = moved_by(T_cw, x[: 6 * count].reshape(count, 6))
        centres = -np.einsum("nij,ni->nj", poses[:, :3, :3], poses[:, :3, 3])
        pair = (torch.from_numpy(c[fitted]) for c in (centres, truth))
        scale, R, t = (v.numpy() for v in umeyama(*pair))
        squares += ((scale * centres @ R.T + t - truth) ** 2).sum(1)
        axes = np.einsum("nji,njk->nik", poses[:, :3, :3], T_cw[:, :3, :3])
        by = Rotation.from_matrix(axes).as_rotvec()
        turned += np.square(by - by[fitted].mean(0)).sum(1)
    assert 0.01 * place == pytest.approx(np.sqrt(squares / samples), rel=0.15)
    assert 0.01 * turn == pytest.approx(np.sqrt(turned / samples), rel=0.15)
