"""Depth averaged over planes by the CUDA kernel against PyTorch."""

import pytest
import torch

from cuda_emulator import use_emulator
from geogs.geometry import depth_maps as maps
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import averaged_once, averaged_once_on_gpu, averaged_over_planes

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
