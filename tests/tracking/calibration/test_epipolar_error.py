"""Sampson's distance against the distance that it stands for, and its derivatives."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch

from geogs.geometry.lie import so3_exp
from geogs.tracking.calibration.epipolar_error import (
    EpipolarState,
    MatchedPairs,
    errors,
    linearised,
)


def random_pairs(seed: int, pairs: int, matches: int) -> tuple[MatchedPairs, EpipolarState]:
    """Matches of points before two cameras, half a pixel beside where they should be."""
    rng = np.random.default_rng(seed)
    focal = 250.0
    R = so3_exp(torch.from_numpy(rng.normal(size=(pairs, 3)) * 0.1))
    t = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(pairs, 3))))
    p = torch.from_numpy(rng.uniform(-150, 150, (pairs, matches, 2)))
    z = torch.from_numpy(rng.uniform(2, 6, (pairs, matches, 1)))
    X = torch.cat([p / focal, torch.ones_like(z)], -1) * z @ R.mT + 0.5 * t[:, None]
    q = focal * X[..., :2] / X[..., 2:] + torch.from_numpy(rng.normal(size=p.shape) * 0.5)
    weight = torch.ones_like(z[..., 0])
    return MatchedPairs(p, q, weight), EpipolarState(R, t, torch.tensor(math.log(focal)).double())


def test_it_is_how_far_a_match_has_to_move():
    pairs, state = random_pairs(0, 2, 4)
    found, focal = errors(pairs, state), float(state.log_focal.exp())
    K = np.diag([1 / focal, 1 / focal, 1.0])
    for k in range(2):
        t, R = state.t[k].numpy(), state.R[k].numpy()
        F = K @ np.cross(np.eye(3), t) @ R @ K
        for n in range(4):
            match = np.r_[pairs.first[k, n].numpy(), pairs.second[k, n].numpy()]

            def off(x: np.ndarray, F: np.ndarray = F) -> float:
                return 1e4 * float(np.r_[x[2:], 1] @ F @ np.r_[x[:2], 1])

            nearest = scipy.optimize.minimize(
                lambda x, match=match: ((x - match) ** 2).sum(), match,
                constraints={"type": "eq", "fun": off}, method="SLSQP", tol=1e-12,
            )  # fmt: skip
            assert abs(float(found[k, n])) == pytest.approx(math.sqrt(nearest.fun), rel=0.01)
            assert math.copysign(1, off(match)) == math.copysign(1, float(found[k, n]))


def test_k1_bends_the_rays_as_the_lens_does():
    pairs, state = random_pairs(1, 3, 20)
    k1, focal = 0.002, state.log_focal.exp()

    def bent(p: torch.Tensor) -> torch.Tensor:
        return p * (1 + k1 * (p / focal).square().sum(-1, keepdim=True))

    through = MatchedPairs(bent(pairs.first), bent(pairs.second), pairs.weight)
    straight = errors(pairs, state)
    assert (errors(through, state) - straight).abs().max() > 0.03
    assert (errors(through, state, k1) - straight).abs().max() < 0.003


def test_derivatives_are_those_of_finite_differences():
    pairs, state = random_pairs(2, 5, 30)
    error, J = linearised(pairs, state)
    torch.testing.assert_close(error, errors(pairs, state))
    for m in range(7):
        h = torch.zeros(7, dtype=torch.float64)
        h[m] = 1e-6

        def at(step: torch.Tensor) -> torch.Tensor:
            return errors(pairs, state.moved(step[:5].expand(5, 5), step[5]), step[6])

        numerical = (at(h) - at(-h)) / 2e-6
        assert numerical.abs().max() > 1e-3
        assert (J[..., m] - numerical).abs().max() < 1e-7 * J[..., m].abs().max()
