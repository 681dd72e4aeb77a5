"""The rotation between two views, and which of two models a flow speaks for."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geogs.geometry.lie import se3_inverse, so3_exp, so3_log
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.matching.two_view_rotation import (
    epipolar_squares,
    fit_rotation,
    gric,
    two_view_rotation,
)
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA, pose, render

GRID = SampleGrid(CAMERA)
SIGMA = 0.3


def flow(T_ji: np.ndarray, depth: np.ndarray, noise: float = 0.0, seed: int = 0) -> FlowMatch:
    """The true flow of the cells at some depths, with noise of so many pixels."""
    rays = GRID.rays.double().numpy()
    X = (rays * depth[:, None]) @ T_ji[:3, :3].T + T_ji[:3, 3]
    x = np.stack([CAMERA.fx * X[:, 0], CAMERA.fy * X[:, 1]], 1) / X[:, 2:]
    x = x + np.array([CAMERA.cx, CAMERA.cy]) + np.random.default_rng(seed).normal(0, noise, x.shape)
    pixels = torch.from_numpy(x).float()[None]
    weight = GRID.inside(pixels).float()[..., None].expand(-1, -1, 2) / SIGMA**2
    return FlowMatch(pixels, weight)


def turned(*angles: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(angles).as_matrix()
    return T


DEPTH = 2.0 + np.random.default_rng(1).uniform(-0.8, 0.8, GRID.size)


def angle(R: torch.Tensor, T: np.ndarray) -> float:
    """Degrees between a rotation and that of a pose."""
    return math.degrees(float(so3_log(R @ torch.from_numpy(T[:3, :3]).mT).norm()))


def test_a_rotation_is_found_though_a_third_of_the_matches_is_wrong() -> None:
    T = turned(0.05, -0.2, 0.08)
    match = flow(T, DEPTH, noise=0.2)
    wrong = torch.arange(GRID.size) % 3 == 0
    match.pixels[:, wrong] += torch.tensor([25.0, 12.0])
    found = fit_rotation(GRID, match)
    assert found is not None
    assert angle(found.R, T) < 0.05
    assert 0.55 < found.agreeing < 0.75
    inside = match.weight[0, :, 0] > 0
    assert len(found.squares) == int(inside.sum())


def test_the_rotation_is_that_of_a_general_minimiser() -> None:
    """Geman and McClure's loss at its sharpest, minimised by finite differences."""
    match = flow(turned(0.03, 0.1, -0.05), DEPTH, noise=0.4)
    found = fit_rotation(GRID, match)
    assert found is not None
    used = (match.weight[0, :, 0] > 0).numpy()
    rays, seen = GRID.rays.double().numpy()[used], match.pixels[0].double().numpy()[used]
    reach = 0.005 * 192

    def residuals(phi: np.ndarray) -> np.ndarray:
        X = rays @ Rotation.from_rotvec(phi).as_matrix().T
        x = np.stack([CAMERA.fx * X[:, 0], CAMERA.fy * X[:, 1]], 1) / X[:, 2:]
        squares = ((seen - x - [CAMERA.cx, CAMERA.cy]) ** 2).sum(1)
        return np.sqrt(squares / (1 + squares / reach**2))

    best = least_squares(residuals, so3_log(found.R).numpy() + 1e-3).x
    assert np.linalg.norm(best - so3_log(found.R).numpy()) < 3e-5


def test_errors_off_epipolar_lines_are_distances_to_them() -> None:
    T = turned(0.02, 0.05, 0.0)
    T[:3, 3] = 0.3, 0.1, -0.05
    match = flow(T, DEPTH, noise=0.5)
    squares = epipolar_squares(GRID, match, torch.from_numpy(T))
    K = CAMERA.matrix().numpy()
    t = T[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(K).T @ cross @ T[:3, :3] @ np.linalg.inv(K)
    used = np.flatnonzero((match.weight[0, :, 0] > 0).numpy())
    for k, cell in list(enumerate(used))[::50]:
        p = np.append(GRID.pixels[cell].double().numpy(), 1)
        q = np.append(match.pixels[0, cell].double().numpy(), 1)
        line = F @ p
        distance = (q @ line) / np.hypot(*line[:2])
        assert squares[k] == pytest.approx(distance**2 / (SIGMA**2 + 0.1**2), rel=1e-4)


def test_the_criterion_by_hand() -> None:
    squares = np.array([0.5, 3.0, 100.0])
    n = 3
    assert gric(squares, 2, 3) == pytest.approx(
        0.5 + 3.0 + 4.0 + 2 * n * math.log(4) + 3 * math.log(4 * n)
    )
    assert gric(squares, 3, 5) == pytest.approx(
        0.5 + 2.0 + 2.0 + 3 * n * math.log(4) + 5 * math.log(4 * n)
    )


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_speaks_for_a_rotation_and_parallax_for_more(seed: int) -> None:
    T = turned(0.02, -0.15, 0.03)
    pure = two_view_rotation(GRID, flow(T, DEPTH, SIGMA, seed))
    assert pure is not None
    assert pure.is_pure
    assert angle(pure.R, T) < 0.05
    T[:3, 3] = 0.1, 0.03, 0.0  # 4 to 12 pixels, most of which a rotation takes up
    moved = two_view_rotation(GRID, flow(T, DEPTH, SIGMA, seed))
    assert moved is not None
    assert not moved.is_pure
    assert angle(moved.R, T) < 0.5


def test_guesses_do_not_outvote_matches() -> None:
    """What a network guesses of bare walls agrees with a rotation and with more."""
    T = turned(0.02, -0.15, 0.03)
    T[:3, 3] = 0.1, 0.03, 0.0
    match = flow(T, DEPTH, SIGMA, 0)
    guessed = torch.arange(GRID.size) % 4 > 0
    match.weight[0, guessed] = 1 / 12**2
    found = two_view_rotation(GRID, match)
    assert found is not None
    assert not found.is_pure


def test_nothing_is_said_of_noise() -> None:
    rng = np.random.default_rng(0)
    pixels = torch.from_numpy(rng.uniform(0, 140, (1, GRID.size, 2))).float()
    assert two_view_rotation(GRID, FlowMatch(pixels, torch.ones_like(pixels))) is None
    assert two_view_rotation(GRID, FlowMatch(pixels, torch.zeros_like(pixels))) is None


def test_rendered_views_are_told_apart() -> None:
    operator = ClassicalFlow(GRID)
    for T_wc, is_pure in ((pose(0.0, yaw=0.12), True), (pose(0.15, 0.02, 0.0, 0.02), False)):
        first, second = (operator.encode(render(T)[0]) for T in (pose(0.0), T_wc))
        there, _ = operator.measure([first], [second], fine=False)
        found = two_view_rotation(GRID, there)
        assert found is not None
        assert found.is_pure is is_pure
        assert angle(found.R, se3_inverse(torch.from_numpy(T_wc)).numpy()) < (0.1, 0.6)[not is_pure]


def test_exponentials_agree() -> None:
    from geogs.tracking.matching.two_view_rotation import _exponential

    phi = np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(
        _exponential(phi), so3_exp(torch.from_numpy(phi)).numpy(), atol=1e-12
    )
