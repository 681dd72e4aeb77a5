"""The camera with unknowns against autograd and OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from geogs.bundle.lens import LensBlock
from geogs.bundle.projection import relative_motion
from geogs.geometry.lie import retract
from lens_scene import CAMERA, GRID, lens_problem
from oracles.calibration_reference import reproject
from oracles.lens_reference import linearised


@pytest.mark.parametrize("distortion", [(0.0, 0.0), (0.15, -0.2), (-0.2, 0.05)])
def test_jacobians_match_autograd(distortion):
    p = lens_problem(CAMERA.moved(0.0, *distortion))
    T = relative_motion(p.T_cw, p.source, p.target)[:1]
    pixels, d = GRID.pixels.double(), p.inverse_depth[:1].double()
    block = LensBlock(CAMERA.moved(0.0, *distortion), pixels)
    seen, by, by_depth = linearised(block, p.T_cw, p.source[:1], p.target[:1], d)

    def moved(xi, unknowns, delta):
        return reproject(CAMERA, pixels, unknowns, retract(xi, T[0]), d[0] + delta)

    at = (
        torch.zeros(6, dtype=torch.float64),
        torch.tensor([0.0, *distortion], dtype=torch.float64),
        torch.zeros(GRID.size, dtype=torch.float64),
    )
    torch.testing.assert_close(seen.pixels[0], moved(*at), rtol=1e-9, atol=1e-9)
    Jx, Jl, Jd = torch.autograd.functional.jacobian(moved, at)
    Jd = torch.stack([Jd[k, :, k] for k in range(GRID.size)], -1)
    expected = torch.cat([Jx, Jl], -1).permute(2, 1, 0)
    torch.testing.assert_close(by[0], expected, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(by_depth[0], Jd, rtol=1e-7, atol=1e-7)


def test_the_lens_is_that_of_opencv():
    lens = CAMERA.moved(0.0, -0.12, 0.03)
    K, distortion = CAMERA.matrix().numpy(), np.array([-0.12, 0.03, 0, 0])
    pixels = GRID.pixels.double()
    rays = LensBlock(lens, pixels).rays
    back, _ = cv2.projectPoints(rays.numpy(), np.zeros(3), np.zeros(3), K, distortion)
    np.testing.assert_allclose(back[:, 0], pixels.numpy(), atol=1e-7)
    eye, same = torch.eye(4, dtype=torch.float64)[None], torch.zeros(1, dtype=torch.long)
    depth = torch.ones(1, GRID.size, dtype=torch.float64)
    p = LensBlock(lens, pixels).project(eye, same, same, depth)
    np.testing.assert_allclose(p.pixels[0].numpy(), pixels.numpy(), atol=1e-7)
    assert p.valid.all()
