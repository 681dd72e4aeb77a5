"""Normals of planes fitted to inverse depths: exact at any slant, unbent by noise and by steps."""

import math

import numpy as np
import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.fitted_normals import fitted_normals
from geogs.splat.init import fit_local_planes

CAMERA = Camera(186.0, 186.0, 79.5, 30.0, 160, 60)


def plane_depth(normal: torch.Tensor, height: float) -> torch.Tensor:
    """z of the plane ``normal . X = -height`` where it lies before the camera, else 0."""
    facing = CAMERA.rays() @ normal
    return torch.where(facing < -0.02, -height / facing, 0.0)


def grid(depth: torch.Tensor, step: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns of every so many-th pixel with a depth."""
    v, u = (depth > 0).nonzero().unbind(1)
    chosen = (v % step == 0) & (u % step == 0)
    return v[chosen], u[chosen]


def degrees(found: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Angles to a unit normal."""
    return torch.rad2deg(torch.acos((found @ normal).clamp(-1, 1)))


def unit(*xyz: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(xyz), dim=0)


ROAD = unit(0.02, -1.0, 0.03)


@pytest.mark.parametrize("normal", [ROAD, unit(0.0, 0.0, -1.0), unit(0.9, 0.1, -0.4)])
def test_a_plane_is_exact_at_any_slant_and_faces_the_camera(normal):
    depth = plane_depth(normal, 1.5)
    v, u = grid(depth)
    found = fitted_normals(depth, torch.ones_like(depth), CAMERA, (v, u), 3)
    known = (found != 0).any(1)
    assert known.float().mean() > 0.9
    assert degrees(found[known], normal).max() < 0.1
    assert ((found * CAMERA.rays()[v, u]).sum(-1)[known] < 0).all()


def test_a_noisy_road_does_not_lean_as_one_of_points_does():
    depth = plane_depth(ROAD, 1.5)
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
    depth = torch.where(depth < 25, depth * (1 + 0.0005 * depth * noise), 0.0)
    v, u = grid(depth)
    found = fitted_normals(depth, torch.ones_like(depth), CAMERA, (v, u), 3)
    known = (found != 0).any(1)
    assert known.float().mean() > 0.9
    lean = torch.rad2deg(torch.asin(found[known, 2])) - math.degrees(math.asin(ROAD[2]))
    assert lean.median().abs() < 0.1
    assert degrees(found[known], ROAD).median() < 1.0
    points = (CAMERA.rays() * depth[..., None])[v, u]
    of_points = fit_local_planes(points, points[:0], 12).normal
    of_points = of_points * -torch.sign((of_points * points).sum(-1, keepdim=True))
    assert degrees(of_points, ROAD).median() > 2 * degrees(found[known], ROAD).median()


def test_a_step_bends_no_plane():
    near, far = plane_depth(unit(0.3, 0.0, -1.0), 1.0), plane_depth(unit(-0.3, 0.0, -1.0), 1.6)
    is_near = torch.arange(CAMERA.width) < 80
    depth = torch.where(is_near, near, far)
    v, u = torch.full((6,), 30), torch.tensor([77, 78, 79, 80, 81, 82])
    found = fitted_normals(depth, torch.ones_like(depth), CAMERA, (v, u), 4)
    assert degrees(found[:3], unit(0.3, 0.0, -1.0)).max() < 0.1
    assert degrees(found[3:], unit(-0.3, 0.0, -1.0)).max() < 0.1


def test_depths_count_by_their_weight_and_holes_not_at_all():
    depth = plane_depth(ROAD, 1.5)
    wrong = depth.clone()
    wrong[::2] *= 1.01
    weight = torch.ones_like(depth)
    weight[::2] = 0
    wrong[:, ::5] = 0
    v, u = grid(wrong[1::2])
    v = 2 * v + 1
    found = fitted_normals(wrong, weight, CAMERA, (v, u), 4)
    known = (found != 0).any(1)
    assert known.float().mean() > 0.9
    assert degrees(found[known], ROAD).max() < 0.1


def test_nothing_is_said_of_a_lonely_pixel():
    depth = torch.zeros(CAMERA.height, CAMERA.width)
    depth[20, 30] = depth[40, 100] = depth[40, 101] = 2.0
    v, u = depth.nonzero().unbind(1)
    assert (fitted_normals(depth, torch.ones_like(depth), CAMERA, (v, u), 4) == 0).all()


def test_a_window_is_a_robust_fit_of_least_squares():
    """Against NumPy's, of one window, gone on with until nothing changes."""
    depth = plane_depth(unit(0.2, -0.5, -1.0), 2.0)
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(1))
    depth = depth * (1 + 0.002 * noise)
    v, u, radius = 30, 70, 4
    pixels = torch.tensor([v]), torch.tensor([u])
    found = fitted_normals(depth, torch.ones_like(depth), CAMERA, pixels, radius)[0]
    window = (1 / depth[v - 4 : v + 5, u - 4 : u + 5]).double().numpy()
    own = window[4, 4]
    dv, du = np.mgrid[-4:5, -4:5]
    x, y = (u + du - CAMERA.cx) / CAMERA.fx, (v + dv - CAMERA.cy) / CAMERA.fy
    basis, values = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3), window.ravel()
    plane = np.linalg.lstsq(basis, values, rcond=None)[0]
    for _ in range(20):  # converged: the first slopes do not matter
        share = ((values - basis @ plane) / own / 0.02) ** 2
        root = np.sqrt(np.clip(1 - share, 0, None) ** 2)
        plane = np.linalg.lstsq(basis * root[:, None], values * root, rcond=None)[0]
    expected = torch.from_numpy(-plane / np.linalg.norm(plane)).float()
    assert degrees(found[None], expected).max() < 0.2


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_says_the_same():
    depth = plane_depth(ROAD, 1.5)
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(2))
    depth = depth * (1 + 0.003 * noise)
    v, u = grid(depth)
    weight = torch.rand(depth.shape, generator=torch.Generator().manual_seed(3))
    expected = fitted_normals(depth, weight, CAMERA, (v, u), 4)
    found = fitted_normals(depth.cuda(), weight.cuda(), CAMERA, (v.cuda(), u.cuda()), 4).cpu()
    assert ((found != 0).any(1) == (expected != 0).any(1)).float().mean() > 0.99
    both = (found != 0).any(1) & (expected != 0).any(1)
    assert (found[both] - expected[both]).abs().quantile(0.99) < 1e-3
