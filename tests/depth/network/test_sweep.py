"""Planes in the views of neighbours, against one point after the other."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.depth.network.plane_views import (
    TriedDepths,
    cell_rays,
    log_planes,
    sample_cells,
    see_planes,
)
from geogs.geometry.lie import se3_exp


def test_planes_are_evenly_spaced_in_their_logarithm():
    planes = log_planes(torch.tensor([0.5, 1.0]), torch.tensor([8.0, 3.0]), 5).exp()
    assert planes[0].tolist() == pytest.approx([0.5, 1.0, 2.0, 4.0, 8.0], rel=1e-5)
    assert planes[1, 2] == pytest.approx(3**0.5)


def test_cells_are_seen_where_points_are_projected():
    rng = torch.Generator().manual_seed(1)
    T = se3_exp(0.15 * torch.randn(2, 6, generator=rng))
    lens = torch.tensor([[30.0, 32.0, 15.0, 11.0], [28.0, 27.0, 16.5, 12.5]])
    other = lens + 0.7
    height, width = 6, 8
    depths = torch.tensor([[0.7, 1.0, 1.6], [0.01, 2.0, 4.0]])
    rays = cell_rays(lens, height, width)
    seen = see_planes(rays, TriedDepths.planes(depths.log()), T, other, height, width)
    step = np.diff(np.log(depths.numpy()), axis=1).mean(1)
    checked = 0
    for b in range(2):
        fx, fy, cx, cy = lens[b].tolist()
        gx, gy, ox, oy = other[b].tolist()
        R, t = T[b, :3, :3].double().numpy(), T[b, :3, 3].double().numpy()
        for d in range(3):
            for row in range(height):
                for column in range(width):
                    z = float(depths[b, d])
                    ray = np.array([(4 * column + 1.5 - cx) / fx, (4 * row + 1.5 - cy) / fy, 1.0])
                    y = R @ (z * ray) + t
                    p = row * width + column
                    if y[2] < 0.05:
                        continue
                    x = gx * y[0] / y[2] + ox
                    v = gy * y[1] / y[2] + oy
                    assert seen.cells[b, d, p].tolist() == pytest.approx(
                        [(x - 1.5) / 4, (v - 1.5) / 4], abs=2e-3
                    )
                    inside = -0.5 < x < 4 * width - 0.5 and -0.5 < v < 4 * height - 0.5
                    assert bool(seen.seen[b, d, p]) == inside
                    assert float(seen.log_z[b, d, p]) == pytest.approx(math.log(y[2]), abs=1e-4)
                    across = R @ ray
                    cosine = across @ y / np.linalg.norm(across) / np.linalg.norm(y)
                    assert float(seen.angle[b, d, p]) == pytest.approx(
                        math.acos(min(cosine, 1)), abs=3e-3
                    )
                    further = R @ (z * math.exp(1e-4) * ray) + t
                    moved = np.hypot(
                        gx * further[0] / further[2] + ox - x, gy * further[1] / further[2] + oy - v
                    )
                    expected = math.log(moved / 1e-4 * step[b] + 1e-3)
                    assert float(seen.log_step[b, d, p]) == pytest.approx(expected, abs=2e-2)
                    checked += 1
    assert checked > 200


def test_cells_are_sampled_bilinearly_and_are_nothing_outside():
    rng = torch.Generator().manual_seed(2)
    field = torch.randn(1, 3, 4, 5, generator=rng)
    cells = torch.tensor([[[[1.25, 2.5], [4.0, 3.0], [9.0, 1.0]]]])
    found = sample_cells(field, cells)[0, :, 0]
    by_hand = 0.5 * (0.75 * field[0, :, 2, 1] + 0.25 * field[0, :, 2, 2])
    by_hand = by_hand + 0.5 * (0.75 * field[0, :, 3, 1] + 0.25 * field[0, :, 3, 2])
    torch.testing.assert_close(found[:, 0], by_hand)
    torch.testing.assert_close(found[:, 1], field[0, :, 3, 4])
    assert found[:, 2].abs().max() == 0


def test_depths_of_single_cells_of_any_size_are_seen_like_planes():
    rng = torch.Generator().manual_seed(3)
    T, lens = (
        se3_exp(0.1 * torch.randn(1, 6, generator=rng)),
        torch.tensor([[30.0, 32.0, 15.0, 11.0]]),
    )
    planes = torch.tensor([[0.7, 1.0, 1.6]]).log()
    rays = cell_rays(lens, 12, 16, 2)
    wanted = [
        see_planes(rays, replace(TriedDepths.planes(planes), cell=2), T, lens, 12, 16),
        see_planes(rays, replace(TriedDepths.planes(planes + 0.1), cell=2), T, lens, 12, 16),
    ]
    odd = torch.arange(rays.shape[2]) % 2 == 1
    mixed = torch.where(odd, planes[..., None] + 0.1, planes[..., None])
    step = torch.diff(planes, dim=1).mean(1)
    found = see_planes(rays, TriedDepths(mixed, planes, step, 2), T, lens, 12, 16)
    for name in ("log_z", "angle", "log_step"):
        one, two = (getattr(w, name) for w in wanted)
        torch.testing.assert_close(getattr(found, name), torch.where(odd, two, one))
    expected = torch.where(odd[:, None], wanted[1].cells, wanted[0].cells)
    torch.testing.assert_close(found.cells, expected)
    # The centre of a cell of two pixels lies half a pixel further than its first.
    assert rays[0, 0, 1] - rays[0, 0, 0] == pytest.approx(2 / 30)
    assert rays[0, 0, 0] == pytest.approx((0.5 - 15) / 30)
