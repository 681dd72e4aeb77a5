"""The pinhole camera: projection and resizing."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from lenses import LENSES

F64 = torch.float64
CAMERA = Camera(fx=300.0, fy=310.0, cx=151.3, cy=117.9, width=320, height=240)


def test_project_inverts_back_projection():
    depth = torch.rand(240, 320, dtype=F64) + 0.5
    pixels, z = CAMERA.project(CAMERA.back_project(depth))
    v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    assert (pixels - torch.stack([u, v], -1)).abs().max() < 1e-10
    assert (z - depth).abs().max() < 1e-14


def test_k_takes_points_to_pixels():
    x, y, z = CAMERA.K @ [0.2, -0.1, 2.0]
    u, v = CAMERA.project(torch.tensor([0.2, -0.1, 2.0], dtype=F64))[0]
    assert (x / z, y / z) == (pytest.approx(float(u)), pytest.approx(float(v)))


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


@pytest.mark.parametrize("name", LENSES)
def test_pixels_and_points_of_a_camera_that_bends_are_opencv_s(name):
    camera = replace(CAMERA, **LENSES[name])
    pixels = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)).double()
    pixels = pixels * torch.tensor([camera.width - 1.0, camera.height - 1.0])
    plane = camera.plane(pixels)
    points = np.c_[plane.numpy(), np.ones(50)]
    wanted = opencv_pixels(camera, points)
    np.testing.assert_allclose(wanted[:, 0], pixels, atol=1e-6)
    np.testing.assert_allclose(camera.pixels(plane), pixels, atol=1e-6)
    shown, z = camera.project(2 * torch.from_numpy(points))
    np.testing.assert_allclose(shown, pixels, atol=1e-6)
    assert (z == 2).all()
    numeric = [(camera.bent(plane + step) - camera.bent(plane - step)) / 2e-6
               for step in 1e-6 * torch.eye(2).double()]  # fmt: skip
    xx, xy, yy = camera.bend_jacobian(plane)
    torch.testing.assert_close(torch.stack([xx, xy], -1), numeric[0], atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(torch.stack([xy, yy], -1), numeric[1], atol=1e-6, rtol=1e-6)
    step = torch.tensor([0.3, -0.2]).double().expand_as(plane)
    there = camera.bent_step(plane, step)
    torch.testing.assert_close(there, step[:, :1] * numeric[0] + step[:, 1:] * numeric[1])
    torch.testing.assert_close(camera.unbent_step(plane, there), step)
    assert camera.shows(plane).all()
    torch.testing.assert_close(camera.as_pinhole(pixels), camera.pinhole.pixels(plane))
    square = plane.square().sum(-1)
    for n, by in enumerate(camera.radial_shapes(square)[1:], 1):
        changed = (
            replace(camera, **{f"k{n}": getattr(camera, f"k{n}") + h}) for h in (1e-6, -1e-6)
        )
        high, low = (other.growth(square) for other in changed)
        torch.testing.assert_close(by, (high - low) / 2e-6, atol=1e-8, rtol=1e-6)


def opencv_pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    none, K = np.zeros(3), camera.K
    if not camera.is_fisheye:
        return cv2.projectPoints(points, none, none, K, np.array(camera.distortion))[0]
    k = np.array([camera.k1, camera.k2, camera.k3, camera.k4])
    return cv2.fisheye.projectPoints(points[:, None], none, none, K, k)[0]


@pytest.mark.parametrize("name", ["radial", "brown", "fisheye"])
def test_a_camera_does_not_show_what_its_lens_folds_over(name):
    camera = replace(CAMERA, **LENSES[name] | {"k1": -0.4, "k2": 0.0, "k3": 0.0, "k4": 0.0})
    radius = torch.linspace(0.01, 3.0, 300).double()
    plane = torch.stack([radius, torch.zeros_like(radius)], -1)
    grows = camera.growth(radius.square()).mul(radius).diff() > 0
    shown = camera.shows(plane)[:-1]
    assert (grows | ~shown).all()
    assert 0 < (grows & ~shown).sum() < 60  # where it hardly grows
    assert shown[0]
    beyond = torch.tensor([[5e3, 5e1], [-3e3, 1e4], [1e6, -1e6]])
    found = camera.plane(beyond)
    assert found.isfinite().all()
    farthest = (
        float(radius[:-1][shown].max()) if camera.is_fisheye else float(found.norm(dim=-1)[0])
    )
    torch.testing.assert_close(found.norm(dim=-1), torch.full((3,), farthest), atol=0.02, rtol=0.3)


def test_moves_of_a_camera_add_up_and_are_found_again():
    moves = 0.1, -0.2, 0.05, 0.01, -0.02
    moved = CAMERA.moved(*moves)
    assert moved.moves_from(CAMERA) == pytest.approx(moves)
    assert moved.fx == pytest.approx(math.exp(0.1) * CAMERA.fx)
    assert moved.cx == pytest.approx(CAMERA.cx + 0.01 * moved.fx)
    assert CAMERA.moves_from(CAMERA) == (0.0,) * 5
    assert moved.pinhole.is_pinhole
    with pytest.raises(InputError, match="bends rays"):
        moved.required_pinhole()
    assert CAMERA.required_pinhole() is CAMERA
