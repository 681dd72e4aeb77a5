"""Depth averaged over planes by the CUDA kernel against PyTorch."""

import math

import pytest
import torch

from cuda_emulator import use_emulator
from geogs.geometry import depth_maps as maps
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import averaged_once, averaged_once_on_gpu, averaged_over_planes
from geogs.geometry.jumps import JUMP

CAMERA = Camera(fx=60.0, fy=62.0, cx=25.2, cy=17.1, width=53, height=37)
GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
    ],
)


@pytest.fixture(params=["cpu", GPU])
def device(request, monkeypatch):
    """The kernel emulated on the CPU, or on a GPU."""
    if request.param == "cpu":
        use_emulator(monkeypatch, maps)
    return torch.device(request.param)


def steps_and_holes() -> tuple[torch.Tensor, torch.Tensor]:
    """Depth and normals of a slanted wall with noise, a step and holes."""
    random = torch.Generator().manual_seed(3)
    normal = torch.tensor([0.3, -0.5, -1.0]) + 0.05 * torch.randn(37, 53, 3, generator=random)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    depth = -1.7 / (normal * CAMERA.rays()).sum(-1)
    depth[:, 30:] *= 1.2
    depth[torch.rand(depth.shape, generator=random) < 0.1] = 0
    return depth, normal


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_one_round_is_that_of_pytorch(device, radius):
    depth, normal = steps_and_holes()
    inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-9), 0.0)
    tilted = [inverse * normal[..., k] / 60 for k in (0, 1)]
    expected = averaged_once(inverse, *tilted, radius, 0.02)
    told = [m.contiguous().to(device) for m in (inverse, *tilted)]
    found = averaged_once_on_gpu(*told, radius, 0.02).cpu()
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-7)


def test_what_is_averaged_on_a_gpu_is_what_is_on_the_cpu(device):
    depth, normal = steps_and_holes()
    expected = averaged_over_planes(depth, normal, CAMERA, 3, 0.02)
    found = averaged_over_planes(depth.to(device), normal.to(device), CAMERA, 3, 0.02).cpu()
    assert found == pytest.approx(expected, rel=1e-4)
    assert not torch.equal(expected, depth)


@pytest.fixture(params=["pytorch", "cpu", GPU])
def averaging(request, monkeypatch):
    """Where depth is averaged: by PyTorch, by the kernel emulated, or by it on a GPU."""
    if request.param == "cpu":
        use_emulator(monkeypatch, maps)
        monkeypatch.setattr(maps, "averaged_once", averaged_once_on_gpu)
    return torch.device("cuda" if request.param == "cuda" else "cpu")


@pytest.mark.parametrize("reach", [0.0, 0.006, 0.02, JUMP, 1.0, 2.0, 2e6, math.inf])
@pytest.mark.parametrize("step", [1 / (1 - 1.2 * JUMP), 1.2, 10.0])
def test_steps_holes_and_planes_stay_at_any_reach(averaging, reach, step):
    """Both sides keep to their planes as far as noise of 0.1 % goes; nothing fills a hole."""
    random = torch.Generator().manual_seed(4)
    normal = torch.tensor([0.3, -0.5, -1.0]).expand(37, 53, 3)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    plane = -1.7 / (normal * CAMERA.rays()).sum(-1)
    plane[:, 30:] *= step
    noise = 1e-3 * torch.randn(plane.shape, generator=random).clamp(-3, 3)
    hole = torch.rand(plane.shape, generator=random) < 0.05
    hole[10:20, 24:36] = True
    depth = torch.where(hole, 0.0, plane * (1 + noise))
    told = depth.to(averaging), normal.to(averaging)
    found = averaged_over_planes(*told, CAMERA, 3, reach).cpu()
    assert bool((found[hole] == 0).all())
    off = found[~hole] / plane[~hole] - 1
    assert float(off.abs().max()) <= float(noise[~hole].abs().max()) + 1e-6
    assert float(off.std()) < (1.01e-3 if reach == 0 else 4e-4)
