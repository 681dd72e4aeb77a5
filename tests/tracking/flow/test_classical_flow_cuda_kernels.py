"""Single kernels of the GPU's flow operator against slow, plain references."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from cuda_emulator import use_emulator
from geogs.geometry.camera import Camera
from geogs.tracking.flow import classical_flow_cuda
from geogs.tracking.flow.cell_texture import SHARP, UNINFORMED
from geogs.tracking.flow.classical_flow import ClassicalFlow, StartFlow, _DenseFlow
from geogs.tracking.flow.classical_flow_cuda import DEVIATION, SOURCES, CudaClassicalFlow
from geogs.world.grid import SampleGrid

ALPHA, GAMMA, DELTA, ZETA2, EPS2, RELAXATION = 30.0, 10.0, 2.0, 0.01, 1e-4, 1.5


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    if request.param == "emulated":
        use_emulator(monkeypatch, classical_flow_cuda)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    return torch.device("cuda")


def smooth(rng: np.random.Generator, height: int, width: int, sigma: float, scale: float):
    """A smooth random image of a given standard deviation, float32."""
    x = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), sigma)
    return x * np.float32(scale / x.std())


@dataclass
class Scene:
    """Two directed pairs of a size, with a flow for each."""

    images: list[np.ndarray]
    warped: list[np.ndarray]
    flow: np.ndarray

    @classmethod
    def random(cls, height: int, width: int) -> "Scene":
        rng = np.random.default_rng(7)
        images = [127 + smooth(rng, height, width, 1.5, 30) for _ in range(2)]
        warped = [im + smooth(rng, height, width, 2.0, 4) for im in images]
        parts = [[smooth(rng, height, width, 4, 0.6) for _ in "xy"] for _ in images]
        return cls(images, warped, np.moveaxis(np.array(parts), 1, -1).copy())

    def on(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
        """Table of the images, the warped images, and what the table points to."""
        kept = [torch.from_numpy(im).to(device) for im in self.images]
        table = torch.tensor([k.data_ptr() for k in kept], device=device)
        return table, torch.from_numpy(np.stack(self.warped)).to(device), kept


def cubic(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Cubic convolution with a = -1/2, border repeated."""
    h, w = image.shape
    x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)

    def kernel(t: np.ndarray) -> np.ndarray:
        t = np.abs(t)
        near, far = 1.5 * t**3 - 2.5 * t**2 + 1, -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
        return np.where(t <= 1, near, np.where(t < 2, far, 0))

    total = np.zeros_like(x)
    for r in range(-1, 3):
        for c in range(-1, 3):
            value = image[np.clip(j + r, 0, h - 1), np.clip(i + c, 0, w - 1)]
            total += kernel(x - i - c) * kernel(y - j - r) * value
    return total


def data_terms(image: np.ndarray, target: np.ndarray, flow: np.ndarray):
    """Matrix (h, w, 2, 2) and right side (h, w, 2) of the linearised data terms."""
    h, w = image.shape
    v, u = np.mgrid[:h, :w]
    moved = cubic(target.astype(float), u + flow[..., 0], v + flow[..., 1])
    mean, diff = (np.pad(p, 2, mode="edge") for p in ((image + moved) / 2, moved - image))

    def dx(a):
        return np.pad((a[:, 2:] - a[:, :-2]) / 2, [(0, 0), (1, 1)])

    def dy(a):
        return dx(a.T).T

    def inner(a):
        return a[2:-2, 2:-2]

    g = inner(np.stack([dx(mean), dy(mean)], -1))
    gx = inner(np.stack([dx(dx(mean)), dy(dx(mean))], -1))
    gy = inner(np.stack([dx(dy(mean)), dy(dy(mean))], -1))
    d, d_x, d_y = inner(diff), inner(dx(diff)), inner(dy(diff))
    n, nx, ny = (1 / ((a**2).sum(-1) + ZETA2) for a in (g, gx, gy))
    brightness = DELTA * n / np.sqrt(n * d**2 + EPS2)
    gradient = GAMMA / np.sqrt(nx * d_x**2 + ny * d_y**2 + EPS2)
    terms = ((brightness, g, d), (gradient * nx, gx, d_x), (gradient * ny, gy, d_y))
    A = sum(k[..., None, None] * a[..., :, None] * a[..., None, :] for k, a, _ in terms)
    c = sum((k * ((a * flow).sum(-1) - r))[..., None] * a for k, a, r in terms)
    return A, c


def refined(image: np.ndarray, target: np.ndarray, flow: np.ndarray, sweeps: int) -> np.ndarray:
    """One linearisation, relaxed over the whole image at once, colour by colour."""
    flow = flow.astype(float)
    A, c = data_terms(image, target, flow)
    step_x = np.diff(flow, axis=1, append=flow[:, -1:])
    step_y = np.diff(flow, axis=0, append=flow[-1:])
    weight = ALPHA / np.sqrt((step_x**2 + step_y**2).sum(-1) + EPS2)
    east, south = weight.copy(), weight.copy()
    east[:, -1], south[-1] = 0, 0
    west, north = np.roll(east, 1, axis=1), np.roll(south, 1, axis=0)
    around = ((east, -1, 1), (west, 1, 1), (south, -1, 0), (north, 1, 0))
    v, u = np.mgrid[: flow.shape[0], : flow.shape[1]]
    matrix = A + sum(k for k, _, _ in around)[..., None, None] * np.eye(2)
    for half in range(2 * sweeps):
        pull = sum(k[..., None] * np.roll(flow, s, axis=axis) for k, s, axis in around)
        solved = np.linalg.solve(matrix, (c + pull)[..., None])[..., 0]
        colour = ((u + v + half) % 2 == 0)[..., None]
        flow = np.where(colour, flow + RELAXATION * (solved - flow), flow)
    return flow


@pytest.mark.parametrize(("size", "sweeps"), [((21, 22), 30), ((31, 57), 2)])
def test_refinement(device: torch.device, size: tuple[int, int], sweeps: int) -> None:
    # One tile relaxed at length; several tiles for as many sweeps as their overlap is exact.
    h, w = size
    scene = Scene.random(h, w)
    table, warped, _kept = scene.on(device)
    before = torch.from_numpy(scene.flow).to(device)
    after = torch.full_like(before, float("nan"))
    kernel = classical_flow_cuda.kernels_for(SOURCES / "flow_refine.cu", device)["flow_refine"]
    kernel(
        (-(-w // 24), -(-h // 24), 2), (32, 8), table, warped, before, after, h * w, w, h, 0,
        sweeps, ALPHA, GAMMA, DELTA, ZETA2, EPS2, RELAXATION,
    )  # fmt: skip
    for k in (0, 1):
        expected = refined(scene.images[k], scene.warped[k], scene.flow[k], sweeps)
        assert np.abs(expected - scene.flow[k]).max() > 0.1
        np.testing.assert_allclose(after[k].cpu().numpy(), expected, atol=2e-3)


def test_densification(device: torch.device) -> None:
    h, w = 21, 26
    scene = Scene.random(h, w)
    table, warped, _kept = scene.on(device)
    origins_x, origins_y = (sorted({min(4 * k, n - 8) for k in range(9)}) for n in (w, h))
    rng = np.random.default_rng(2)
    motion = rng.normal(0, 1.0, (2, len(origins_y), len(origins_x), 2)).astype(np.float32)
    flow = torch.full((2, h, w, 2), float("nan"), device=device)
    kernel = classical_flow_cuda.kernels_for(SOURCES / "flow_search.cu", device)["flow_densify"]
    patches = torch.from_numpy(motion).to(device)
    kernel((1, 3, 2), (32, 8), table, warped, patches, flow, h * w, w, h, 0)
    for d in (0, 1):
        total, weight = np.zeros((h, w, 2)), np.zeros((h, w, 1))
        for r, y in enumerate(origins_y):
            for c, x in enumerate(origins_x):
                v, u = np.mgrid[y : y + 8, x : x + 8]
                f = motion[d, r, c]
                at_u, at_v = np.clip(u + f[0], 0, w - 1), np.clip(v + f[1], 0, h - 1)
                i, j = np.minimum(at_u.astype(int), w - 2), np.minimum(at_v.astype(int), h - 2)
                su, sv, T = at_u - i, at_v - j, scene.warped[d].astype(float)
                top = (1 - su) * T[j, i] + su * T[j, i + 1]
                below = (1 - su) * T[j + 1, i] + su * T[j + 1, i + 1]
                residual = (1 - sv) * top + sv * below - scene.images[d][v, u]
                k = (1 / np.maximum(np.abs(residual), 1))[..., None]
                total[v, u] += k * f
                weight[v, u] += k
        np.testing.assert_allclose(flow[d].cpu().numpy(), total / weight, atol=2e-4)


@pytest.mark.parametrize("level", [0, 1])
def test_matches_are_those_of_the_cpu(device: torch.device, level: int) -> None:
    camera = Camera(90.0, 90.0, 48.0, 36.0, 97, 74)
    grid = SampleGrid(camera)
    reference, operator = ClassicalFlow(grid), CudaClassicalFlow(SampleGrid(camera, device))
    rng = np.random.default_rng(4)
    # Structure of all strengths, from hardly any to more than counts.
    waves = smooth(rng, camera.height, camera.width, 2, 1.0)
    waves *= np.geomspace(2, 60, camera.width, dtype=np.float32) / waves.std()
    rgb = np.repeat(np.clip(127 + waves, 0, 255).astype(np.uint8)[..., None], 3, -1)
    half = reference._half if level else reference._full
    h, w = half.u.shape
    # The two directions nearly undo each other.
    there = np.stack([smooth(rng, h, w, 5, 1.0) for _ in "xy"], -1)
    back = -there + np.stack([smooth(rng, h, w, 5, 0.3) for _ in "xy"], -1)
    warp = np.stack([smooth(rng, grid.height, grid.width, 3, 2.0) for _ in "xy"], -1)
    start = np.stack([grid.pixels.numpy() + s * warp.reshape(-1, 2) for s in (1, -1)])
    image = reference.encode(rgb)
    grey = image.half if level else image.grey
    flows = [
        _DenseFlow(half, StartFlow(s * warp), f, grey, grey) for s, f in ((1, there), (-1, back))
    ]

    encoded = operator.encode(rgb)
    table = torch.tensor([encoded.data.data_ptr()] * 2, device=device)
    dense = torch.from_numpy(np.stack([there, back])).to(device)
    begin = torch.from_numpy(start).to(device)
    pixels = torch.empty(2, grid.size, 2, device=device)
    weight = torch.empty_like(pixels)
    pyramid = operator._layout.pyramid
    warped = encoded.data[:pyramid].repeat(2, 1)
    found = torch.empty(2, h, w, device=device)
    operator._kernels["flow_found"](
        (-(-w // 32), -(-h // 8), 2), (32, 8), warped, dense, found, pyramid, camera.width,
        camera.height, level,
    )  # fmt: skip
    operator._kernels["flow_match"](
        (-(-grid.size // 8), 2), (32, 8), table, dense, begin[0], begin[1], found, pixels, weight,
        1, camera.width, camera.height, grid.width, grid.height, level, SHARP, UNINFORMED, 1.0,
        *((1.7 if level else 1.0) * d for d in DEVIATION),
    )  # fmt: skip
    for k in (0, 1):
        expected, expected_weight = reference._match(flows[k], flows[1 - k])
        # OpenCV interpolates at steps of 1/32 pixel.
        np.testing.assert_allclose(pixels[k].cpu().numpy(), expected, atol=0.03)
        for axis in (0, 1):
            a, b = weight[k, :, axis].cpu().numpy(), expected_weight[:, axis]
            assert ((a > 0) == (b > 0)).mean() > 0.97
            both = (a > 0) & (b > 0)
            assert both.mean() > 0.3
            ratio = np.sqrt(a[both] / b[both])
            assert np.abs(np.median(ratio) - 1) < 0.01
            assert np.quantile(np.abs(ratio - 1), 0.9) < (0.2 if level else 0.05)
