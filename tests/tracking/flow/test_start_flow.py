"""Flow between the cells of the grid."""

import math

import numpy as np
import pytest
import torch

from geogs.bundle.projection import project
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.flow.start_flow import Lattice, StartFlow
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA

ROWS, COLUMNS = 7, 9


def slowly(flow: np.ndarray, u: float, v: float) -> np.ndarray:
    """The interpolant by its formula, a number at a time."""
    rows, columns, _ = flow.shape

    def bend(line: np.ndarray, k: int) -> float:
        """Second difference between cells k and k + 1 of a row or column."""
        second = [line[n - 1] - 2 * line[n] + line[n + 1] for n in range(1, len(line) - 1)]
        ends = [second[min(max(n - 1, 0), len(second) - 1)] for n in (k, k + 1)]
        if ends[0] * ends[1] <= 0:
            return 0.0
        return min(ends, key=abs)

    u, v = min(max(u, 0), columns - 1), min(max(v, 0), rows - 1)
    i, j = min(math.floor(u), columns - 2), min(math.floor(v), rows - 2)
    a, b = u - i, v - j
    found = np.zeros(2)
    for c in (0, 1):
        f = flow[..., c].astype(float)
        linear = (1 - b) * ((1 - a) * f[j, i] + a * f[j, i + 1])
        linear += b * ((1 - a) * f[j + 1, i] + a * f[j + 1, i + 1])
        across = (1 - b) * bend(f[j], i) + b * bend(f[j + 1], i)
        down = (1 - a) * bend(f[:, i], j) + a * bend(f[:, i + 1], j)
        found[c] = linear - a * (1 - a) / 2 * across - b * (1 - b) / 2 * down
    return found


@pytest.fixture(scope="module")
def flow() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.normal(0, 3, (ROWS, COLUMNS, 2)).cumsum(1).astype(np.float32)


def test_points_are_those_of_the_formula(flow):
    points = np.random.default_rng(1).uniform(-1, [COLUMNS, ROWS], (300, 2))
    expected = np.stack([slowly(flow, *p) for p in points])
    np.testing.assert_allclose(StartFlow(flow).at(points), expected, atol=1e-4)


def test_a_lattice_is_the_points_it_is_made_of(flow):
    u, v = ((np.arange(8 * n, dtype=np.float32) - 4) / 8 for n in (COLUMNS, ROWS))
    points = np.stack(np.meshgrid(u, v), -1)
    expected = StartFlow(flow).at(points.reshape(-1, 2)).reshape(points.shape)
    found = StartFlow(flow).on(Lattice(u, v, ROWS, COLUMNS))
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_quadratic_is_exact():
    v, u = np.mgrid[:ROWS, :COLUMNS].astype(float)

    def curved(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.stack([0.3 * u**2 - v + 2, 0.2 * v**2 + 0.1 * u * v - 0.4 * u**2], -1)

    points = np.random.default_rng(2).uniform(0, [COLUMNS - 1, ROWS - 1], (100, 2))
    np.testing.assert_allclose(StartFlow(curved(u, v)).at(points), curved(*points.T), atol=1e-4)


def test_a_step_does_not_overshoot():
    step = np.where(np.arange(COLUMNS) < 4, 0.0, 20.0)
    flow = np.broadcast_to(step[None, :, None], (ROWS, COLUMNS, 2))
    points = np.stack([np.linspace(0, COLUMNS - 1, 200), np.full(200, 2.4)], -1)
    found = StartFlow(flow).at(points)
    assert found.min() >= 0
    assert found.max() <= 20


def test_matches_of_a_road_are_not_too_short():
    """Forward over a textured floor by as much as the camera is above it, from a right start."""
    grid, height = SampleGrid(CAMERA), 1.0
    rng = np.random.default_rng(3)
    period = 12.0
    waves = [(*rng.normal(0, 5.0 / height, 2), rng.uniform(0, 6.3)) for _ in range(40)]

    def view(z: float) -> np.ndarray:
        """The floor from a camera at z, looking along it."""
        y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
        down = np.maximum((y - CAMERA.cy) / CAMERA.fy, 1e-3)
        depth = np.minimum(height / down, period)
        right = depth * (x - CAMERA.cx) / CAMERA.fx
        grey = sum(np.cos(p * right + q * (depth + z) + r) for p, q, r in waves)
        return np.clip(128 + 12 * grey, 0, 255).astype(np.uint8)[..., None].repeat(3, -1)

    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = -1.0
    down = grid.rays[:, 1]
    d = (down / height).clamp(min=1 / period)[None]
    truth = project(CAMERA, grid.rays, T[None], d).pixels
    back = project(CAMERA, grid.rays, torch.linalg.inv(T)[None], d).pixels
    operator = ClassicalFlow(grid)
    a, b = (operator.encode(view(z)) for z in (0.0, 1.0))
    match, _ = operator.measure([a], [b], truth, back)
    road = (d[0] > 1.2 / period) & (match.weight[0, :, 1] > 0)
    error = (match.pixels - truth)[0, road, 1]
    assert int(road.sum()) > 60
    assert abs(float(error.median())) < 0.05
