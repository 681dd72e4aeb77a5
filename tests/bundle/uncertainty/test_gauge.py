"""Deviations without their gauge against samples that are aligned, and for any gauge the same."""

import numpy as np
import pytest
import torch

from geogs.bundle.uncertainty.gauge import deviations_after_alignment
from geogs.evaluation.rotation_errors import best_rotation, rotation_angle
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.geometry.umeyama import umeyama


def walk(n: int = 7, spread: float = 1.0) -> torch.Tensor:
    """Poses along a bent path."""
    g = torch.Generator().manual_seed(5)
    xi = torch.randn(n, 6, dtype=torch.float64, generator=g)
    xi[:, :3] *= spread
    return se3_exp(xi)


def covariance(n: int, seed: int = 1) -> torch.Tensor:
    """Of perturbations of a thousandth, correlated between all poses."""
    A = torch.randn(
        6 * n, 6 * n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    return 1e-6 * A @ A.mT / n


def _aligned(centres: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Centres after the similarity that brings them nearest to the true ones."""
    s, R, t = umeyama(torch.from_numpy(centres), torch.from_numpy(truth))
    return (s * torch.from_numpy(centres) @ R.mT + t).numpy()


def test_samples_aligned_one_by_one_spread_as_foretold():
    T, n = walk(), 7
    C = covariance(n)
    found = deviations_after_alignment(T, C)
    xi = np.random.default_rng(2).multivariate_normal(np.zeros(6 * n), C.numpy(), 3000)
    moved = se3_exp(torch.from_numpy(xi).reshape(-1, n, 6)) @ T
    centres, truth = se3_inverse(moved)[..., :3, 3].numpy(), se3_inverse(T)[:, :3, 3].numpy()
    aligned = np.stack([_aligned(c, truth) for c in centres])
    position = np.sqrt(np.square(aligned - truth).sum(-1).mean(0))
    assert found.position.numpy() == pytest.approx(position, rel=0.06)
    R, R_true = se3_inverse(moved)[..., :3, :3].numpy(), se3_inverse(T)[:, :3, :3].numpy()
    angles = np.stack([np.radians(rotation_angle(best_rotation(r, R_true) @ r, R_true)) for r in R])
    assert found.rotation.numpy() == pytest.approx(np.sqrt((angles**2).mean(0)), rel=0.06)


def test_what_a_similarity_does_is_no_error():
    T = walk()
    c = se3_inverse(T)[:, :3, 3]
    # The whole world moved, turned and grown: what each pose's perturbation is then.
    g = torch.randn(7, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    moves = [
        torch.cat([T[:, :3, :3] @ v, torch.zeros(7, 3, dtype=torch.float64)], 1)
        for v in torch.eye(3, dtype=torch.float64)
    ]
    grown = torch.cat([(T[:, :3, :3] @ c[..., None])[..., 0], torch.zeros_like(c)], 1)
    turned = []
    for axis in torch.eye(3, dtype=torch.float64):
        tau = T[:, :3, :3] @ torch.linalg.cross(axis.expand_as(c), c)[..., None]
        turned.append(torch.cat([tau[..., 0], T[:, :3, :3] @ axis], 1))
    J = torch.stack([*moves, *turned, grown]).reshape(7, -1)
    C = covariance(7)
    first = deviations_after_alignment(T, C)
    second = deviations_after_alignment(T, C + 1e-3 * J.mT @ (g @ g.mT) @ J)
    torch.testing.assert_close(second.position, first.position, rtol=1e-6, atol=0)
    assert float(first.position.min()) > 1e-4
    free = deviations_after_alignment(T, J.mT @ J)
    assert float(free.position.max()) < 1e-6
    assert float(free.rotation.max()) < 1e-6


def test_cameras_at_one_place_have_only_their_mean_taken_out():
    found = deviations_after_alignment(walk(spread=0.0), torch.eye(42, dtype=torch.float64))
    assert found.position.numpy() == pytest.approx(np.sqrt(3 * (1 - 1 / 7)), rel=1e-6)
