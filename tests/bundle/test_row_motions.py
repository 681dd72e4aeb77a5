"""Rows of a rolling shutter in the adjustment: against points that are followed one by one."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import relative_motion
from geogs.bundle.row_motions import RowMotions, RowTimes, fitted_twists
from geogs.bundle.shared import solve_shared, usual_residual
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.world.grid import SampleGrid
from lens_scene import CAMERA, disturbed

TIMES = RowTimes(0.0, 1 / CAMERA.height, 0.5 / CAMERA.height - 0.5)
"""The first row half a readout before the middle of the image, the last half a one after it."""
READOUT = 0.02


def scene(
    camera: Camera, readout: float = READOUT, frames: int = 8
) -> tuple[BundleProblem, RowMotions, SampleGrid]:
    """Matches of a camera that is shaken, each seen at the time of its own row in both views."""
    g, grid = torch.Generator().manual_seed(1), SampleGrid(camera)
    k = torch.arange(frames, dtype=torch.float64)
    xi = torch.stack([0.1 * k, 0.1 * k.sin(), 0.05 * k, 0.05 * k.cos(), 0.1 * k.sin(), 0 * k], 1)
    T, d = se3_exp(xi), 0.4 + 0.3 * torch.rand(frames, grid.size, generator=g)
    twist = torch.randn(frames, 6, generator=g) * torch.tensor([0.4, 0.4, 0.4, 0.5, 0.5, 0.5])
    source, target = (
        torch.tensor(x)
        for x in zip(
            *[(i, j) for i in range(frames) for j in range(frames) if 0 < abs(i - j) < 4],
            strict=True,
        )
    )
    at = torch.stack([
        seen(camera, grid.pixels, T[j] @ torch.linalg.inv(T[i]), d[i], twist[i], twist[j], readout)
        for i, j in zip(source, target, strict=True)
    ])  # fmt: skip
    inside = grid.inside(at)[..., None].expand_as(at)
    free = k > 0
    problem = BundleProblem(
        T, d, source, target, free, torch.ones_like(free),
        pixels=torch.where(inside, at, grid.centre).float(), weight=400.0 * inside,
    )  # fmt: skip
    return problem, RowMotions(twist, TIMES), grid


def seen(
    camera: Camera, pixels: Tensor, T_ji: Tensor, d: Tensor, own: Tensor, other: Tensor, r: float
) -> Tensor:
    """Where the target's rows show what the source's rows show at its cells; depths are those at
    the time of the source's middle row."""

    def moved(X: Tensor, twist: Tensor, seconds: Tensor) -> Tensor:
        T = se3_exp(seconds[:, None] * twist.double())
        return (T[:, :3, :3] @ X[..., None])[..., 0] + T[:, :3, 3]

    pixels = middle = pixels.double()
    for _ in range(20):  # where the middle row's time has what its own row's time has at the cell
        rays = torch.cat([camera.plane(middle), torch.ones(len(pixels), 1).double()], 1)
        X = rays / d[:, None].double()
        middle = middle + pixels - camera.project(moved(X, own, r * TIMES.of(pixels)))[0]
    Y = X @ T_ji[:3, :3].mT + T_ji[:3, 3]
    at = camera.project(Y)[0]
    for _ in range(20):  # the row says the time, the time the row
        at = camera.project(moved(Y, other, r * TIMES.of(at)))[0]
    return at


def with_rows(problem: BundleProblem, rows: RowMotions, camera: Camera) -> BundleProblem:
    """A problem whose matches are shifted by rows, as its poses and depths have it."""
    T_ji = relative_motion(problem.T_cw, problem.source, problem.target)
    at = camera, SampleGrid(camera).rays, T_ji, problem.inverse_depth
    return replace(problem, by_rows=rows.slopes(*at, problem.source, problem.target))


@pytest.mark.parametrize("bend", [(0.0, 0.0), (0.1, -0.15)])
def test_slopes_are_what_a_short_readout_does(bend):
    camera, short = CAMERA.moved(0.0, *bend), 1e-4
    exact, rows, grid = scene(camera, 0.0)
    rolled, _, _ = scene(camera, short)
    # In double precision: a short readout moves little.
    T_ji = relative_motion(exact.T_cw, exact.source, exact.target)
    depth, rays = exact.inverse_depth.double(), SampleGrid(camera).rays.double()
    rays = torch.cat([camera.plane(grid.pixels.double()), rays[:, 2:]], 1)
    rows = replace(rows, twist=rows.twist.double())
    slopes = rows.slopes(camera, rays, T_ji, depth, exact.source, exact.target)
    pairs = zip(exact.source, exact.target, strict=True)
    for n, (i, j) in enumerate(pairs):
        of = camera, grid.pixels, T_ji[n], exact.inverse_depth[i], rows.twist[i], rows.twist[j]
        numeric = (seen(*of, short) - seen(*of, 0.0)) / short
        used = exact.weight[n, :, 0] > 0
        torch.testing.assert_close(slopes[n][used], numeric[used], rtol=5e-3, atol=0.3)
    assert float((rolled.pixels - exact.pixels).abs().max()) < 0.1


@pytest.mark.parametrize("bend", [(0.0, 0.0), (-0.15, 0.03)])
def test_lens_and_readout_are_found_together(bend):
    """From a pinhole of another focal length and a global shutter; without rows the lens is off."""
    camera = CAMERA.moved(0.0, *bend)
    problem, rows, grid = scene(camera)
    start = disturbed(problem, 0.01, 0.02)
    guess = CAMERA.moved(math.log(1.1))
    without = solve_shared(start, LensBlock(guess, grid.pixels, radial=True))
    found, rolled = None, with_rows(start, rows, guess)
    block = LensBlock(guess, grid.pixels, radial=True, rolls=True)
    for _ in range(3):  # shifts by rows are those of the poses and depths before
        found = solve_shared(rolled, found.block if found else block)
        moved = replace(start, T_cw=found.T_cw, inverse_depth=found.inverse_depth)
        rolled = with_rows(moved, rows, found.block.lens)
    assert found is not None
    assert found.block.readout == pytest.approx(READOUT, rel=0.03)
    off, worse = (abs(r.block.lens.fx / CAMERA.fx - 1) for r in (found, without))
    assert off < 0.004
    assert worse > 2 * off
    assert (found.block.lens.k1, found.block.lens.k2) == pytest.approx(bend, abs=0.02)
    assert len(found.covariance) == 4
    assert usual_residual(rolled, found) < 0.3 * usual_residual(start, without)


def test_a_readout_that_is_known_stays():
    problem, rows, grid = scene(CAMERA)
    block = LensBlock(CAMERA, grid.pixels, readout=READOUT, rolls=False)
    assert block.free == (True, False, False, False)
    found = solve_shared(with_rows(disturbed(problem, 0.01, 0.02), rows, CAMERA), block)
    assert found.block.readout == READOUT
    assert abs(found.block.lens.fx / CAMERA.fx - 1) < 0.003


def test_twists_are_those_of_what_moves_in_the_image():
    """Also where a third of it moves by itself, and where nothing is known there is none."""
    g, grid = torch.Generator().manual_seed(2), SampleGrid(CAMERA)
    d = 0.4 + 0.3 * torch.rand(2, grid.size, generator=g)
    twist = torch.tensor([[0.3, -0.2, 0.5, 0.2, -0.6, 0.1], [0.0, 0.4, 0.0, 0.0, 0.3, -0.2]])
    short = 1e-3
    ends = [
        seen(CAMERA, grid.pixels, se3_exp(short * t.double()), d[n], 0 * t, 0 * t, 0.0)
        for n, t in enumerate(twist)
    ]
    velocity = ((torch.stack(ends) - grid.pixels) / short).float()
    known = torch.ones(2, grid.size, dtype=torch.bool)
    torch.testing.assert_close(
        fitted_twists(CAMERA, grid.rays, d, velocity, known), twist, atol=2e-3, rtol=0
    )
    velocity[:, ::3] += 60.0
    torch.testing.assert_close(
        fitted_twists(CAMERA, grid.rays, d, velocity, known), twist, atol=0.03, rtol=0
    )
    none = fitted_twists(CAMERA, grid.rays, d, velocity, torch.zeros_like(known))
    assert not none.any()
