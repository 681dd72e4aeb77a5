"""Depth maps to normals."""

import torch

from geogs.geometry.camera import Camera
from geogs.geometry.depth import normals_from_depth

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
