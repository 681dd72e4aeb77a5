"""The pinhole camera: projection and resizing."""

import cv2
import numpy as np
import pytest
import torch

from geogs.geometry.camera import Camera

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
