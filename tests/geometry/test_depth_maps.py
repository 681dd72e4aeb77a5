"""Depth maps to normals."""

import pytest
import torch

from geogs.geometry import depth_maps
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import averaged_over_planes, normals_from_depth

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
