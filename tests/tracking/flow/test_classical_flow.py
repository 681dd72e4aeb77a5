"""The classical flow operator on views of a known room."""

import math

import cv2
import numpy as np
import pytest
import torch

from geogs.bundle.projection import project
from geogs.tracking.flow import classical_flow
from geogs.tracking.flow.classical_flow import ClassicalFlow, Lattice, StartFlow, match_deviation
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA, pose, render

GRID = SampleGrid(CAMERA)
ROWS, COLUMNS = 7, 9


def true_positions(a: np.ndarray, b: np.ndarray) -> torch.Tensor:
    """Where the cells seen from pose a lie in the view from pose b."""
    depth = torch.from_numpy(render(a)[1][4:-3:8, 4:-3:8].reshape(1, -1).copy()).float()
    T = torch.from_numpy(np.linalg.inv(b) @ a)[None]
    return project(CAMERA, GRID.rays, T, 1 / depth).pixels


A, B = pose(0.0), pose(0.12, 0.02, 0.05, 0.03)
THERE, BACK = true_positions(A, B), true_positions(B, A)


def errors(match, truth) -> tuple[torch.Tensor, torch.Tensor]:
    used = match.weight[0, :, 0] > 0
    return (match.pixels - truth)[0].norm(dim=-1)[used], used


@pytest.fixture(scope="module")
def operator() -> ClassicalFlow:
    return ClassicalFlow(GRID)


@pytest.fixture(scope="module")
def views(operator):
    return operator.encode(render(A)[0]), operator.encode(render(B)[0])


def test_it_is_a_flow_operator(operator):
    assert isinstance(operator, FlowOperator)


def test_cold_start_matches_most_cells(operator, views):
    there, back = operator.measure([views[0]], [views[1]])
    for match, truth in ((there, THERE), (back, BACK)):
        error, used = errors(match, truth)
        assert float(used.float().mean()) > 0.6
        assert float(error.median()) < 0.2


def test_warm_start_repairs_a_wrong_reprojection(operator, views):
    wave = 1.5 * torch.sin(GRID.pixels.flip(-1) / 40)
    there, back = operator.measure([views[0]], [views[1]], THERE + wave, BACK + wave)
    for match, truth in ((there, THERE), (back, BACK)):
        error, used = errors(match, truth)
        assert float(used.float().mean()) > 0.7
        assert float(error.median()) < 0.15
        assert float(error.median()) < 0.2 * float(wave.norm(dim=-1).median())


def test_coarse_measurement_of_a_large_image_is_less_certain():
    camera = CAMERA.resized(CAMERA.width * 3, CAMERA.height * 3)
    grid = SampleGrid(camera)
    operator = ClassicalFlow(grid)
    a, b = (operator.encode(cv2.resize(render(T)[0], None, fx=3, fy=3)) for T in (A, B))
    start = grid.pixels[None].repeat(1, 1, 1)
    fine, coarse = (operator.measure([a], [b], start, start, fine=f)[0] for f in (True, False))
    agree = (fine.pixels - coarse.pixels).norm(dim=-1)
    assert 0 < float(agree.median()) < 0.6
    assert float(coarse.weight.median()) < float(fine.weight.median())


def test_weights_order_the_errors(operator, views):
    wave = 0.7 * torch.sin(GRID.pixels.flip(-1) / 30)
    there, _ = operator.measure([views[0]], [views[1]], THERE + wave, BACK + wave)
    error, used = errors(there, THERE)
    order = there.weight[0, used, 0].argsort(descending=True)
    best, worst = error[order[: len(order) // 3]], error[order[-len(order) // 3 :]]
    assert float(best.mean()) < 0.5 * float(worst.mean())


@pytest.mark.parametrize("gain", [0.5, 1.3])
def test_a_change_of_light_hardly_matters(operator, views, gain):
    image = render(B)[0].astype(np.float32)
    ramp = np.linspace(gain, 0.9 * gain, image.shape[1], dtype=np.float32)[None, :, None]
    dark = operator.encode(np.clip(image * ramp + 12, 0, 255).astype(np.uint8))
    there, _ = operator.measure([views[0]], [dark], THERE, BACK)
    error, used = errors(there, THERE)
    assert float(used.float().mean()) > 0.6
    assert float(error.median()) < 0.2


def test_what_leaves_the_image_has_no_weight(operator, views):
    far = pose(0.6)
    truth = true_positions(A, far)
    there, _ = operator.measure(
        [views[0]], [operator.encode(render(far)[0])], truth, true_positions(far, A)
    )
    assert float(there.weight[~GRID.inside(truth, 0.0)].max()) == 0


def test_little_of_noise_is_matched(operator, views):
    noise = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width, 3), np.uint8)
    there, _ = operator.measure([views[0]], [operator.encode(noise)], THERE, BACK)
    assert float((there.weight[..., 0] > 0).float().mean()) < 0.3


@pytest.mark.parametrize("fine", [True, False])
def test_a_bare_wall_says_little_however_noisy_the_images_are(monkeypatch, operator, fine):
    monkeypatch.setattr(classical_flow, "SMALL_IMAGE", 0)
    rng = np.random.default_rng(5)
    clean = render(A)[0].astype(np.float64)
    clean[:, : CAMERA.width // 2] = 128
    noisy = (np.clip(clean + rng.normal(0, 5, clean.shape), 0, 255) for _ in range(2))
    a, b = (operator.encode(image.astype(np.uint8)) for image in noisy)
    there, _ = operator.measure([a], [b], GRID.pixels[None], GRID.pixels[None], fine)
    weight = there.weight[0].mean(-1) * match_deviation(np.zeros(1), np.zeros(1)).item() ** 2
    is_bare = GRID.pixels[:, 0] < CAMERA.width // 2 - 12
    is_textured = GRID.pixels[:, 0] > CAMERA.width // 2 + 12
    assert float(weight[is_bare].mean()) < 0.1 * float(weight[is_textured].mean())


def test_grey_levels_are_those_of_the_image(operator):
    image = render(A)[0]
    image[..., 0] //= 2
    grey = operator.grey(operator.encode(image))
    assert grey.dtype == torch.float32
    np.testing.assert_array_equal(grey.numpy(), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def test_texture_is_a_fraction_of_the_image(operator):
    black = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    half = render(A)[0].copy()
    half[:, : CAMERA.width // 2] = 90
    blurred = cv2.GaussianBlur(render(A)[0], (0, 0), 30)
    assert operator.texture(operator.encode(black)) == 0
    assert operator.texture(operator.encode(blurred)) < 0.05
    assert 0.3 < operator.texture(operator.encode(half)) < 0.65
    assert operator.texture(operator.encode(render(A)[0])) > 0.8


def test_a_batch_is_its_single_pairs(operator, views):
    start = torch.cat([THERE, BACK]), torch.cat([BACK, THERE])
    both = operator.measure([views[0], views[1]], [views[1], views[0]], *start)
    one = operator.measure([views[0]], [views[1]], THERE, BACK)
    assert torch.equal(both[0].pixels[0], one[0].pixels[0])
    assert torch.equal(both[0].weight[1], both[1].weight[0])
    assert torch.equal(both[0].weight[0], one[0].weight[0])


def test_deviation_grows_with_both_signs_of_trouble():
    zero = np.zeros(1)
    base = match_deviation(zero, zero)[0]
    assert 0.02 < base < 0.1
    assert match_deviation(zero + 0.5, zero)[0] > base + 0.3
    assert match_deviation(zero, zero + 0.2)[0] > base + 0.3


def test_a_geometry_is_guessed_from_cells_that_count():
    weight = torch.tensor([[100.0, 90.0, 0.5, 0.0, 60.0], [0.02, 0.03, 0.01, 0.0, 0.0]])
    match = FlowMatch(torch.zeros(2, 5, 2), weight[..., None].expand(-1, -1, 2))
    assert match.sure().tolist() == [
        [True, True, False, False, True],
        [True, True, True, False, False],
    ]


# --- between the cells of the grid --------------------------------------------------------------


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
