"""Camera, depth to normals, Umeyama, nearest neighbours."""

import cv2
import numpy as np
import pytest
import torch

from geogs.errors import GeogsError
from geogs.geometry.camera import Camera
from geogs.geometry.depth import normals_from_depth
from geogs.geometry.lie import so3_exp
from geogs.geometry.neighbors import nearest_neighbors
from geogs.geometry.umeyama import umeyama

F64 = torch.float64
CAMERA = Camera(fx=300.0, fy=310.0, cx=151.3, cy=117.9, width=320, height=240)


def test_project_inverts_back_projection():
    depth = torch.rand(240, 320, dtype=F64) + 0.5
    pixels, z = CAMERA.project(CAMERA.back_project(depth))
    v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    assert (pixels - torch.stack([u, v], -1)).abs().max() < 1e-10
    assert (z - depth).abs().max() < 1e-14


def test_resizing_an_image_moves_its_content_as_the_camera_says():
    """A blob's centroid after an area resize lies where the resized camera projects it."""
    point = torch.tensor([0.11, -0.07, 1.9], dtype=F64)
    v, u = np.mgrid[0:240, 0:320]
    for size in [(160, 120), (200, 150), (107, 80), (640, 480)]:
        x, y = CAMERA.project(point)[0].tolist()
        blob = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 8.0**2))
        interpolation = cv2.INTER_AREA if size[0] < 320 else cv2.INTER_LINEAR
        small = cv2.resize(blob, size, interpolation=interpolation)
        sv, su = np.mgrid[0 : size[1], 0 : size[0]]
        centroid = np.array([(su * small).sum(), (sv * small).sum()]) / small.sum()
        expected = CAMERA.resized(*size).project(point)[0].numpy()
        assert np.abs(centroid - expected).max() < 0.01


def test_resizing_there_and_back_is_exact():
    there = CAMERA.resized(77, 131).resized(320, 240)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(there, name) == pytest.approx(getattr(CAMERA, name), rel=1e-14)


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


@pytest.mark.parametrize("with_scale", [True, False])
def test_umeyama_recovers_a_similarity(with_scale):
    g = torch.Generator().manual_seed(1)
    source = torch.randn(40, 3, dtype=F64, generator=g)
    R, t = so3_exp(torch.tensor([0.4, -1.9, 1.2], dtype=F64)), torch.tensor([3.0, -2, 0.5]).double()
    s = 2.7 if with_scale else 1.0
    scale, rotation, translation = umeyama(source, s * source @ R.mT + t, with_scale)
    assert abs(float(scale) - s) < 1e-12
    assert (rotation - R).abs().max() < 1e-12
    assert (translation - t).abs().max() < 1e-12


def test_umeyama_of_a_mirrored_set_is_still_a_rotation():
    source = torch.randn(30, 3, dtype=F64, generator=torch.Generator().manual_seed(2))
    _, R, _ = umeyama(source, source * torch.tensor([1.0, 1, -1], dtype=F64))
    assert float(torch.linalg.det(R)) == pytest.approx(1.0)


def test_umeyama_refuses_a_line():
    line = torch.linspace(0, 1, 10, dtype=F64)[:, None] * torch.tensor([1.0, 2, 3], dtype=F64)
    with pytest.raises(GeogsError, match="line"):
        umeyama(line, line)


def test_nearest_neighbors_agree_with_all_pairs():
    g = torch.Generator().manual_seed(5)
    points, queries = torch.rand(200, 3, generator=g), torch.rand(30, 3, generator=g)
    d, i = nearest_neighbors(queries, points, 4)
    full = torch.cdist(queries.double(), points.double())
    expected, index = full.topk(4, largest=False)
    assert (d - expected.float()).abs().max() < 1e-6
    assert (i == index).all()
    assert nearest_neighbors(queries, points[:3], 5)[0].shape == (30, 3)
