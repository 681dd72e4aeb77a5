"""Kernels of the photometric check against the same in PyTorch."""

from dataclasses import replace

import pytest
import torch

import geogs.tracking.cuda.photometric_check as cuda_check
from cuda_emulator import use_emulator
from geogs.geometry.camera import Camera
from geogs.tracking.matching import photometric_check
from geogs.tracking.matching.photometric_check import (
    MIN_CONTRAST,
    correlation_at,
    correlation_matched,
    matched_motion,
)
from geogs.world.grid import SampleGrid
from lenses import LENSES
from tracking_scenes import CAMERA, pose, render

SIDES = [(192, 144), (95, 61), (511, 290)]


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch) -> torch.device:
    """Where the kernels run; emulated where there is no GPU."""
    if request.param == "emulated":
        use_emulator(monkeypatch, cuda_check)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    return torch.device("cuda")


def by_kernels(grid: SampleGrid, device: torch.device, first, second, **where) -> torch.Tensor:
    there = {name: value.to(device).contiguous() for name, value in where.items()}
    step = photometric_check._spread(grid).step
    found = cuda_check.median_correlation(
        SampleGrid(grid.camera, device), first.to(device), second.to(device), step,
        MIN_CONTRAST**2, **there,
    )  # fmt: skip
    return found.cpu()


def agrees(found: torch.Tensor, expected: torch.Tensor) -> None:
    """The same windows but for some on the verge of counting, and the same median."""
    assert abs(float(found[1] - expected[1])) <= 2
    assert float(found[0]) == pytest.approx(float(expected[0]), abs=2e-3)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("there", [pose(0.12, yaw=0.03), pose(-0.3, 0.05, 0.2, -0.1)])
def test_at_a_pose_it_is_what_pytorch_says(device, there, name):
    grid = SampleGrid(replace(CAMERA, **LENSES[name]))
    (first, depth), (second, _) = render(pose(0.0)), render(there)
    first, second = (torch.from_numpy(x[..., 0].copy()).float() for x in (first, second))
    d = torch.from_numpy(1 / depth[4:-3:8, 4:-3:8].reshape(-1)).float()
    T = torch.linalg.inv(torch.from_numpy(there)) @ torch.from_numpy(pose(0.0))
    T[0, 3] += 0.02  # so that it is not one
    information = (torch.arange(grid.size) % 5 > 0).float()
    expected = correlation_at(grid, first, second, T, d, information)
    found = by_kernels(
        grid, device, first, second, T_ji=T, inverse_depth=d, information=information
    )
    agrees(found, expected)
    assert name != "pinhole" or 0.3 < float(found[0]) < 0.99  # which the images are of
    assert 100 < int(found[1]) < 0.85 * grid.size
    T[2, 3] = -10.0  # behind the camera
    found = by_kernels(
        grid, device, first, second, T_ji=T, inverse_depth=d, information=information
    )
    assert found.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("width", "height"), SIDES)
def test_where_a_flow_leads_it_is_what_pytorch_says(device, width, height):
    grid = SampleGrid(Camera(300.0, 300.0, width / 2, height / 2, width, height))
    g = torch.Generator().manual_seed(width)
    coarse = 200 * torch.rand(1, 1, height // 6, width // 6, generator=g)
    first = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic")[0, 0]
    first[:, : width // 3] = 70.0  # without texture
    second = first + 8 * torch.randn(first.shape, generator=g)
    pixels = grid.pixels + 2.5 * torch.randn(grid.pixels.shape, generator=g)
    expected = correlation_matched(grid, first, second, pixels)
    found = by_kernels(grid, device, first, second, pixels=pixels)
    agrees(found, expected)
    assert 0.1 < float(found[0]) < 0.95
    assert 0.3 < int(found[1]) / min(grid.size, 512) < 0.7


@pytest.mark.parametrize("share", [0.6, 0.0])
def test_the_motion_of_matches_is_what_pytorch_says(device, share):
    grid, g = SampleGrid(CAMERA), torch.Generator().manual_seed(3)
    pixels = grid.pixels + 9 * torch.randn(grid.pixels.shape, generator=g)
    weight = (torch.rand(grid.size, 1, generator=g) < share).float().expand(-1, 2).contiguous()
    expected = matched_motion(grid, pixels, weight)
    there = SampleGrid(CAMERA, device)
    found = cuda_check.matched_motion(there, pixels.to(device), weight.to(device)).cpu()
    torch.testing.assert_close(found.float(), expected, rtol=1e-5, atol=1e-6)
    used = weight[:, 0] > 0
    assert float(found[0]) == pytest.approx(float(used.float().mean()), abs=1e-6)
    if share:
        motion = (pixels - grid.pixels).norm(dim=-1)[used]
        assert float(found[1]) == pytest.approx(float(motion.median()), rel=1e-5)
    else:
        assert float(found[1]) == 0
