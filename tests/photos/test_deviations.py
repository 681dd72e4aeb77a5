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
