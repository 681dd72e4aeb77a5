"""Completion of the tracker's grid."""

import numpy as np
import pytest

from geogs.depth.grid_completion import (
    BENDING,
    MEMBRANE,
    _smoothness_bands,
    complete_inverse_depth,
    upsample_grid,
)
from geogs.geometry.camera import Camera

IMAGE = np.full((96, 128, 3), 127, np.uint8)
SHAPE = (12, 16)


def _plane() -> np.ndarray:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return (0.4 + 0.01 * columns - 0.006 * rows).astype(np.float32)


def test_bands_are_those_of_the_explicit_least_squares():
    rng = np.random.default_rng(0)
    weight, typical = rng.random((5, 4)).astype(np.float32), 0.7
    x = rng.standard_normal((5, 4))
    w = weight.astype(np.float64)
    energy = 0.0
    for axis in (0, 1):
        v, u = np.moveaxis(w, axis, 0), np.moveaxis(x, axis, 0)
        bend = v[1:-1] * (u[:-2] - 2 * u[1:-1] + u[2:]) / (BENDING * typical)
        stretch = np.minimum(v[1:], v[:-1]) * (u[1:] - u[:-1]) / (MEMBRANE * typical)
        energy += (bend**2).sum() + (stretch**2).sum()
    bands = _smoothness_bands(weight, typical)
    n = x.size
    full = np.zeros((n, n))
    for k, band in enumerate(bands):
        rows = np.arange(n - k)
        full[rows + k, rows] = full[rows, rows + k] = band[: n - k]
    flat = x.T.ravel()
    assert flat @ full @ flat == pytest.approx(energy, rel=1e-10)


def test_a_plane_is_kept_and_outliers_are_replaced():
    plane = _plane()
    data, information = plane.copy(), np.full(SHAPE, 4e4, np.float32)
    data[3, 5], data[8, 10] = 1.2, 0.1
    done = complete_inverse_depth(data, information, IMAGE)
    assert np.abs(done.inverse_depth / plane - 1).max() < 0.01
    assert not done.inlier[3, 5]
    assert not done.inlier[8, 10]
    assert done.inlier.mean() > 0.95


def test_holes_are_filled_smoothly():
    plane = _plane()
    information = np.full(SHAPE, 4e4, np.float32)
    information[4:9, 5:11] = 0.0
    data = plane.copy()
    data[4:9, 5:11] = np.nan
    done = complete_inverse_depth(data, information, IMAGE)
    assert np.abs(done.inverse_depth / plane - 1).max() < 0.02
    assert not done.inlier[4:9, 5:11].any()
    assert (done.deviation[4:9, 5:11] > 100).all()
    known = information > 0
    expected = 1.0 / (plane * np.sqrt(4e4))
    assert np.allclose(done.deviation[known], expected[known], rtol=1e-3)


def test_an_image_edge_keeps_a_depth_edge_sharp():
    step = np.full(SHAPE, 0.3, np.float32)
    step[:, 8:] = 0.6
    image = IMAGE.copy()
    image[:, 64:] = 20
    information = np.full(SHAPE, 200.0, np.float32)
    sharp = complete_inverse_depth(step, information, image).inverse_depth
    blurred = complete_inverse_depth(step, information, IMAGE).inverse_depth
    assert np.abs(sharp - step).mean() < 0.3 * np.abs(blurred - step).mean()


@pytest.mark.parametrize("value", [np.nan, 0.0, -2.0])
def test_nothing_known_gives_something_finite(value):
    data = np.full(SHAPE, value, np.float32)
    done = complete_inverse_depth(data, np.ones(SHAPE, np.float32), IMAGE)
    assert np.isfinite(done.inverse_depth).all()
    assert (done.inverse_depth > 0).all()
    assert not done.inlier.any()


def test_upsampling_is_exact_for_linear_grids():
    working = Camera(100.0, 100.0, 63.5, 47.5, 128, 96)
    render = working.resized(64, 48)
    rows, columns = np.mgrid[4:93:8, 4:125:8]
    grid = (2.0 + 0.5 * columns - 0.25 * rows).astype(np.float32)
    out = upsample_grid(grid, working, render)
    v, u = np.mgrid[:48, :64]
    exact = 2.0 + 0.5 * (2 * u + 0.5) - 0.25 * (2 * v + 0.5)
    inner = np.s_[2:-3, 2:-2]
    assert np.abs(out - exact)[inner].max() < 0.02
