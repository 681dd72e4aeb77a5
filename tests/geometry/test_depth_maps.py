"""Normals of depth maps, and their averages over planes."""

import math

import numpy as np
import pytest
import torch

from geogs.geometry import depth_maps
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import averaged_over_planes, fitted_normals, normals_from_depth
from geogs.splat.init import fit_local_planes

F64 = torch.float64
CAMERA = Camera(fx=300.0, fy=310.0, cx=151.3, cy=117.9, width=320, height=240)


def test_normals_of_a_plane_face_the_camera_and_are_exact():
    n = torch.tensor([0.3, -0.5, -1.0], dtype=F64)
    n = n / n.norm()
    rays = CAMERA.rays(F64)
    depth = -1.7 / (rays @ n)
    assert (depth > 0).all()
    normals, valid = normals_from_depth(depth, CAMERA)
    assert (normals[valid] - n).abs().max() < 1e-9
    assert ((normals * rays).sum(-1)[valid] < 0).all()
    assert int(valid.sum()) == 318 * 238


def test_normals_are_invalid_beside_a_hole():
    depth = torch.ones(240, 320, dtype=F64)
    depth[100, 50] = 0
    _, valid = normals_from_depth(depth, CAMERA)
    assert int((~valid).sum()) == 2 * (320 + 238) + 5


def test_normals_from_depth_have_finite_gradients_beside_holes() -> None:
    depth = torch.full((CAMERA.height, CAMERA.width), 2.0)
    depth[:, 5:9] = 0.0
    depth.requires_grad_()
    normals, valid = normals_from_depth(depth, CAMERA)
    assert 0 < int(valid.sum()) < valid.numel()
    normals[..., 0].sum().backward()
    assert depth.grad is not None
    assert torch.isfinite(depth.grad).all()
    assert float(depth.grad.abs().max()) > 0


SMALL = Camera(fx=20.0, fy=21.0, cx=9.2, cy=7.1, width=18, height=14)


def slanted(camera: Camera, offset: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Depth and normals of a plane."""
    n = torch.tensor([0.5, -0.3, -1.0], dtype=F64)
    n = n / n.norm()
    return -offset / (camera.rays(F64) @ n), n.expand(camera.height, camera.width, 3)


def averaged_slowly(depth, normal, camera, radius, reach):
    """One round, pixel by pixel."""
    rays, out = camera.rays(F64), depth.clone()
    for v in range(camera.height):
        for u in range(camera.width):
            if depth[v, u] == 0:
                continue
            top = total = 0.0
            for j in range(max(v - radius, 0), min(v + radius + 1, camera.height)):
                for i in range(max(u - radius, 0), min(u + radius + 1, camera.width)):
                    if depth[j, i] == 0:
                        continue
                    n = normal[j, i]
                    z = float(depth[j, i] * (n @ rays[j, i]) / (n @ rays[v, u]))
                    weight = max(0.0, 1 - ((float(depth[v, u]) / z - 1) / reach) ** 2) ** 2
                    top, total = top + weight / z, total + weight
            out[v, u] = total / top
    return out


def test_averages_over_planes_are_those_of_the_slow_way(monkeypatch):
    monkeypatch.setattr(depth_maps, "_ROUNDS", 1)
    depth, normal = slanted(SMALL, 2.0)
    random = torch.Generator().manual_seed(0)
    depth = depth * (1 + 0.01 * torch.randn(depth.shape, generator=random, dtype=F64))
    normal = normal + 0.05 * torch.randn(normal.shape, generator=random, dtype=F64)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    depth[3:5, 6:9] = 0
    fast = averaged_over_planes(depth, normal, SMALL, 2, 0.02)
    assert fast == pytest.approx(averaged_slowly(depth, normal, SMALL, 2, 0.02), rel=1e-9)


def test_a_plane_stays_and_its_noise_goes():
    depth, normal = slanted(CAMERA, 1.7)
    same = averaged_over_planes(depth, normal, CAMERA, 3, 1e-200)  # whom nobody is near
    assert torch.equal(same, depth)
    exact = averaged_over_planes(depth, normal, CAMERA, 3, 0.01)
    assert exact == pytest.approx(depth, rel=1e-9)
    random = torch.Generator().manual_seed(1)
    noisy = depth * (1 + 0.003 * torch.randn(depth.shape, generator=random, dtype=F64))
    left = averaged_over_planes(noisy, normal, CAMERA, 3, 0.01) / depth - 1
    assert 0.0003 < float(left.std()) < 0.0007  # 0.003 / 7, if all counted alike


def test_steps_and_holes_stay():
    depth, normal = slanted(CAMERA, 1.7)
    depth, hidden = depth.clone(), torch.zeros_like(depth, dtype=torch.bool)
    depth[:, 160:] *= 1.2
    hidden[50:60, 100:200] = True
    depth[hidden] = 0
    found = averaged_over_planes(depth, normal, CAMERA, 3, 0.01)
    assert (found[hidden] == 0).all()
    assert found[~hidden] == pytest.approx(depth[~hidden], rel=1e-9)


WIDE = Camera(186.0, 186.0, 79.5, 30.0, 160, 60)


def plane_depth(normal: torch.Tensor, height: float) -> torch.Tensor:
    """z of the plane ``normal . X = -height`` where it lies before the camera, else 0."""
    facing = WIDE.rays() @ normal
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
    found = fitted_normals(depth, torch.ones_like(depth), WIDE, (v, u), 3)
    known = (found != 0).any(1)
    assert known.float().mean() > 0.9
    assert degrees(found[known], normal).max() < 0.1
    assert ((found * WIDE.rays()[v, u]).sum(-1)[known] < 0).all()


def test_a_noisy_road_does_not_lean_as_one_of_points_does():
    depth = plane_depth(ROAD, 1.5)
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
    depth = torch.where(depth < 25, depth * (1 + 0.0005 * depth * noise), 0.0)
    v, u = grid(depth)
    found = fitted_normals(depth, torch.ones_like(depth), WIDE, (v, u), 3)
    known = (found != 0).any(1)
    assert known.float().mean() > 0.9
    lean = torch.rad2deg(torch.asin(found[known, 2])) - math.degrees(math.asin(ROAD[2]))
    assert lean.median().abs() < 0.1
    assert degrees(found[known], ROAD).median() < 1.0
    points = (WIDE.rays() * depth[..., None])[v, u]
    of_points = fit_local_planes(points, points[:0], 12).normal
    of_points = of_points * -torch.sign((of_points * points).sum(-1, keepdim=True))
    assert degrees(of_points, ROAD).median() > 2 * degrees(found[known], ROAD).median()


def test_a_step_bends_no_plane():
    near, far = plane_depth(unit(0.3, 0.0, -1.0), 1.0), plane_depth(unit(-0.3, 0.0, -1.0), 1.6)
    is_near = torch.arange(WIDE.width) < 80
    depth = torch.where(is_near, near, far)
    v, u = torch.full((6,), 30), torch.tensor([77, 78, 79, 80, 81, 82])
    found = fitted_normals(depth, torch.ones_like(depth), WIDE, (v, u), 4)
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
    found = fitted_normals(wrong, weight, WIDE, (v, u), 4)
    known = (found != 0).any(1)
    assert known.float().mean() > 0.9
    assert degrees(found[known], ROAD).max() < 0.1


def test_nothing_is_said_of_a_lonely_pixel():
    depth = torch.zeros(WIDE.height, WIDE.width)
    depth[20, 30] = depth[40, 100] = depth[40, 101] = 2.0
    v, u = depth.nonzero().unbind(1)
    assert (fitted_normals(depth, torch.ones_like(depth), WIDE, (v, u), 4) == 0).all()


def test_a_window_is_a_robust_fit_of_least_squares():
    """Against NumPy's, of one window, gone on with until nothing changes."""
    depth = plane_depth(unit(0.2, -0.5, -1.0), 2.0)
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(1))
    depth = depth * (1 + 0.002 * noise)
    v, u, radius = 30, 70, 4
    pixels = torch.tensor([v]), torch.tensor([u])
    found = fitted_normals(depth, torch.ones_like(depth), WIDE, pixels, radius)[0]
    window = (1 / depth[v - 4 : v + 5, u - 4 : u + 5]).double().numpy()
    own = window[4, 4]
    dv, du = np.mgrid[-4:5, -4:5]
    x, y = (u + du - WIDE.cx) / WIDE.fx, (v + dv - WIDE.cy) / WIDE.fy
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
    expected = fitted_normals(depth, weight, WIDE, (v, u), 4)
    found = fitted_normals(depth.cuda(), weight.cuda(), WIDE, (v.cuda(), u.cuda()), 4).cpu()
    assert ((found != 0).any(1) == (expected != 0).any(1)).float().mean() > 0.99
    both = (found != 0).any(1) & (expected != 0).any(1)
    assert (found[both] - expected[both]).abs().quantile(0.99) < 1e-3
