"""Projection and its derivatives against autograd and finite differences."""

from dataclasses import replace

import pytest
import torch

from bundle_scenes import CAMERA, scene
from geogs.bundle.projection import linearise, relative_motion
from geogs.geometry.lie import retract
from lenses import LENSES
from oracles.bundle_reference import reproject


@pytest.mark.parametrize("name", LENSES)
def test_jacobians_match_autograd_and_finite_differences(name):
    camera, (grid, p) = replace(CAMERA, **LENSES[name]), scene()
    T = relative_motion(p.T_cw, p.source, p.target)[:1]
    rays, d = grid.rays.double(), p.inverse_depth[:1].double()
    fast = linearise(camera, rays, T, d)

    def moved(xi, delta):
        return reproject(camera, rays, retract(xi, T[0]), d[0] + delta)[0]

    zero = torch.zeros(6, dtype=torch.float64), torch.zeros(grid.size, dtype=torch.float64)
    Jx, Jd = torch.autograd.functional.jacobian(moved, zero)
    Jd = torch.stack([Jd[k, :, k] for k in range(grid.size)])
    torch.testing.assert_close(fast.pose_jacobian[0].permute(2, 1, 0), Jx, rtol=1e-9, atol=1e-8)
    torch.testing.assert_close(fast.depth_jacobian[0], Jd, rtol=1e-9, atol=1e-8)
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-6
        numeric = (moved(step, zero[1]) - moved(-step, zero[1])) / 2e-6
        torch.testing.assert_close(fast.pose_jacobian[0, k].mT, numeric, rtol=1e-6, atol=1e-5)
    numeric = (moved(zero[0], zero[1] + 1e-6) - moved(zero[0], zero[1] - 1e-6)) / 2e-6
    torch.testing.assert_close(fast.depth_jacobian[0], numeric, rtol=1e-6, atol=1e-5)


def test_points_behind_the_target_are_invalid_and_finite():
    grid, p = scene()
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, 2, 3] = -10.0
    out = linearise(CAMERA, grid.rays, T, p.inverse_depth[:1])
    assert not out.valid.any()
    assert torch.isfinite(out.pixels).all()
    assert torch.isfinite(out.pose_jacobian).all()
