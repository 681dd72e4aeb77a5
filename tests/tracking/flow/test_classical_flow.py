"""The classical flow operator on views of a known room."""

import cv2
import numpy as np
import pytest
import torch

from geogs.bundle.projection import project
from geogs.tracking.flow import classical_flow
from geogs.tracking.flow.classical_flow import ClassicalFlow, match_deviation
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA, pose, render

GRID = SampleGrid(CAMERA)


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
