"""The classical flow operator on the GPU against known motions and the operator on the CPU.

Emulated at a small size; on a real GPU also at the size that the tracker works at.
"""

import cv2
import numpy as np
import pytest
import torch

from cuda_emulator import use_emulator
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.tracking.flow import classical_flow_cuda
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.flow.classical_flow_cuda import CudaClassicalFlow
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA, pose, render

SMALL = Camera(90.0, 90.0, 38.5, 27.0, 76, 55)
LARGE = Camera(256.0, 256.0, 255.5, 144.5, 512, 290)


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "emulated":
        use_emulator(monkeypatch, classical_flow_cuda)
        return "cpu"
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    return "cuda"


def operator_on(device: str, small: Camera = SMALL) -> CudaClassicalFlow:
    return CudaClassicalFlow(SampleGrid(LARGE if device == "cuda" else small, device))


def texture(width: int, height: int, seed: int = 3) -> np.ndarray:
    """A band-limited grey texture, float32."""
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    fine = cv2.GaussianBlur(noise, (0, 0), 1.5)
    coarse = cv2.GaussianBlur(noise, (0, 0), 6.0)
    return 127 + 30 * fine / fine.std() + 20 * coarse / coarse.std()


def shifted(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """RGB of the image moved by (dx, dy), exact for a periodic image."""
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n) for n in image.shape), indexing="ij")
    moved = np.fft.ifft2(np.fft.fft2(image) * np.exp(-2j * np.pi * (fx * dx + fy * dy))).real
    return np.repeat(np.clip(np.round(moved), 0, 255).astype(np.uint8)[..., None], 3, -1)


def errors(match, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    used = match.weight[0, :, 0] > 0
    return (match.pixels[0] - truth).norm(dim=-1)[used], used


def test_it_is_a_flow_operator(device: str) -> None:
    assert isinstance(operator_on(device), FlowOperator)


@pytest.mark.parametrize("start", ["cold", "warm"])
def test_a_subpixel_shift_is_found(device: str, start: str) -> None:
    operator = operator_on(device)
    grid = operator.grid
    image = texture(grid.camera.width, grid.camera.height)
    motion = torch.tensor([3.37, -2.21], device=grid.device)
    a, b = operator.encode(shifted(image, 0, 0)), operator.encode(shifted(image, 3.37, -2.21))
    near = 1.3 * torch.sin(grid.pixels.flip(-1) / 40)[None]
    guess = (grid.pixels + motion + near, grid.pixels - motion - near)
    there, back = operator.measure([a], [b], *(guess if start == "warm" else ()))
    for match, truth in ((there, grid.pixels + motion), (back, grid.pixels - motion)):
        used = match.weight[0, :, 0] > 0
        error = (match.pixels[0] - truth).norm(dim=-1)
        # What wraps around at the border has no match.
        inner = grid.inside(truth, 10.0)
        assert float(used[inner].float().mean()) > 0.98
        assert float(error[inner & used].mean()) < 0.05
        assert not used[~grid.inside(truth, 0.0)].any()


def test_texture_is_that_of_the_cpu(device: str) -> None:
    operator = operator_on(device)
    camera = operator.grid.camera
    image = shifted(texture(camera.width, camera.height), 0, 0)
    image[:, camera.width // 2 :] = image[:, camera.width // 2 :] // 60 + 90
    reference = ClassicalFlow(SampleGrid(camera))
    expected, found = reference.encode(image), operator.encode(image)
    share = operator.texture(found)
    assert 0.3 < share < 0.7
    assert share == pytest.approx(reference.texture(expected), abs=2 / operator.grid.size)
    grey = operator.grey(found).cpu()
    torch.testing.assert_close(grey, reference.grey(expected), rtol=0, atol=0.51)


def test_the_pyramid_is_made_of_means(device: str) -> None:
    operator = operator_on(device)
    w, h = operator.grid.camera.width, operator.grid.camera.height
    rgb = np.random.default_rng(5).integers(0, 255, (h, w, 3), np.uint8)
    grey = np.pad(rgb @ [0.299, 0.587, 0.114], [(0, -n % 32) for n in (h, w)], mode="edge")
    data, at = operator.encode(rgb).data.cpu().numpy(), 0
    for k in range(6):
        blocks = grey.reshape(grey.shape[0] >> k, 1 << k, -1, 1 << k)
        level = blocks.mean((1, 3))[: -(-h // 2**k), : -(-w // 2**k)]
        found = data[at : at + level.size].reshape(level.shape)
        np.testing.assert_allclose(found, level, atol=1e-3)
        at += level.size


@pytest.mark.parametrize("gain", [0.6, 1.25])
def test_a_change_of_light_hardly_matters(device: str, gain: float) -> None:
    operator = operator_on(device)
    grid = operator.grid
    image = texture(grid.camera.width, grid.camera.height)
    light = np.linspace(gain, 0.9 * gain, image.shape[1], dtype=np.float32)
    a, b = operator.encode(shifted(image, 0, 0)), operator.encode(shifted(image * light + 6, 0, 0))
    there, _ = operator.measure([a], [b], grid.pixels[None], grid.pixels[None])
    error, used = errors(there, grid.pixels)
    assert float(used.float().mean()) > 0.9
    assert float(error.median()) < 0.1


def test_a_batch_is_its_single_pairs(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    operator = operator_on(device, small=SMALL.resized(49, 40))
    grid = operator.grid
    views = [
        operator.encode(shifted(texture(grid.camera.width, grid.camera.height, s), s, 0))
        for s in (0, 1)
    ]
    start = grid.pixels + torch.stack([0 * grid.pixels, 0 * grid.pixels + 0.7])
    swapped = start.flip(0).contiguous()
    both = operator.measure(views, views[::-1], start, swapped)
    one = operator.measure(views[:1], views[1:], start[:1], swapped[:1])
    for k in (0, 1):
        assert torch.equal(both[k].pixels[0], one[k].pixels[0])
        assert torch.equal(both[k].weight[0], one[k].weight[0])
    assert torch.equal(both[0].pixels[1], both[1].pixels[0])
    monkeypatch.setattr(classical_flow_cuda, "PAIRS_AT_ONCE", 1)
    parts = operator.measure(views, views[::-1], start, swapped)
    for k in (0, 1):
        assert torch.equal(both[k].pixels, parts[k].pixels)
        assert torch.equal(both[k].weight, parts[k].weight)


def test_noise_and_blank_images_are_not_trusted(device: str) -> None:
    operator = operator_on(device)
    grid = operator.grid
    w, h = grid.camera.width, grid.camera.height
    noise = np.random.default_rng(0).integers(0, 255, (2, h, w, 3), np.uint8)
    a, b = (operator.encode(n) for n in noise)
    there, _ = operator.measure([a], [b], grid.pixels[None], grid.pixels[None])
    assert float((there.weight[..., 0] > 0).float().mean()) < 0.12
    blank = operator.encode(np.full((h, w, 3), 90, np.uint8))
    assert operator.texture(blank) == 0
    there, _ = operator.measure([blank], [blank], grid.pixels[None], grid.pixels[None])
    # Unmoved and consistent, but uninformed.
    assert float((there.pixels[0] - grid.pixels).abs().max()) < 1e-3
    assert float(there.weight.max()) < 0.02 / 0.04**2


def test_starts_that_are_no_positions_have_no_weight(device: str) -> None:
    operator = operator_on(device)
    grid = operator.grid
    a = operator.encode(shifted(texture(grid.camera.width, grid.camera.height), 0, 0))
    start = grid.pixels[None].repeat(1, 1, 1)
    start[0, :5] = float("nan")
    start[0, 5:10] = float("inf")
    there, back = operator.measure([a], [a], start, grid.pixels[None])
    for match in (there, back):
        assert match.pixels.isfinite().all()
        assert match.weight.isfinite().all()
    assert float(there.weight[0, :10].max()) == 0
    assert float((there.weight[..., 0] > 0).float().mean()) > 0.6


def test_an_image_of_another_size_is_refused(device: str) -> None:
    with pytest.raises(InputError, match="does not fit"):
        operator_on(device).encode(np.zeros((40, 40, 3), np.uint8))


def true_positions(grid: SampleGrid, a: np.ndarray, b: np.ndarray) -> torch.Tensor:
    """Where the cells seen from pose a lie in the view from pose b."""
    depth = torch.from_numpy(render(a, grid.camera)[1][4:-3:8, 4:-3:8].reshape(-1, 1).copy())
    T = torch.from_numpy(np.linalg.inv(b) @ a)
    points = depth * grid.rays.cpu().double() @ T[:3, :3].T + T[:3, 3]
    cam = grid.camera
    x, y, z = points.unbind(-1)
    return torch.stack([cam.fx * x / z + cam.cx, cam.fy * y / z + cam.cy], -1).float()


@pytest.mark.parametrize("start", ["cold", "warm"])
def test_a_room_is_matched_as_well_as_on_the_cpu(device: str, start: str) -> None:
    small = (128, 96) if start == "warm" else (96, 72)
    camera = CAMERA.resized(*((512, 384) if device == "cuda" else small))
    operator = CudaClassicalFlow(SampleGrid(camera, device))
    grid = SampleGrid(camera)
    reference = ClassicalFlow(grid)
    A, B = pose(0.0), pose(0.12, 0.02, 0.05, 0.03)
    truth = true_positions(grid, A, B), true_positions(grid, B, A)
    wave = 1.5 * torch.sin(grid.pixels.flip(-1) / 40)
    guess = [(t + wave)[None] for t in truth] if start == "warm" else []
    figures = []
    for op in (reference, operator):
        a, b = (op.encode(render(T, camera)[0]) for T in (A, B))
        there, _ = op.measure([a], [b], *(g.to(op.grid.device) for g in guess))
        error, used = errors(there, truth[0].to(op.grid.device))
        figures.append((float(used.float().mean()), float(error.median()), float(error.mean())))
        if start == "warm":
            order = there.weight[0, used, 0].argsort(descending=True)
            best, worst = order[: len(order) // 3], order[-len(order) // 3 :]
            assert float(error[best].mean()) < 0.6 * float(error[worst].mean())
    (kept, median, _), (own_kept, own_median, _) = figures
    assert own_kept > 0.95 * kept
    # A cold start only has to lead to the basin of the warm one.
    assert own_median < 1.1 * median + (0.01 if start == "warm" else 0.03)
