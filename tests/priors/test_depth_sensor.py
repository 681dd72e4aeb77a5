"""The noise of a depth sensor: deviations, edges, holes, and averages over cells and pixels."""

import numpy as np
import pytest
import torch

from geogs.config import DepthSensorConfig
from geogs.priors import depth_sensor
from geogs.priors.depth_sensor import sensor_depth

CONFIG = DepthSensorConfig()


def plane(slope: float, middle: float = 0.4) -> np.ndarray:
    """Depth of a plane: inverse depth changes by ``slope`` a pixel along the rows."""
    u = np.arange(80, dtype=np.float32) - 40
    return np.broadcast_to(1 / (middle + slope * u), (60, 80)).astype(np.float32)


@pytest.mark.parametrize("slope", [0.0, 0.0005, 0.002])
def test_deviations_are_those_of_the_formula(slope):
    found = sensor_depth(plane(slope), CONFIG)
    square = 0.0015**2 + (0.005 * 0.4) ** 2 + (0.5 * slope) ** 2
    assert found.deviation[30, 40] == pytest.approx(np.sqrt(square), rel=1e-4)
    assert (found.inverse_depth[4:-4, 4:-4] > 0).all()


def test_depth_errs_with_its_square(monkeypatch):
    monkeypatch.setattr(depth_sensor, "LATERAL", 0.0)
    config = DepthSensorConfig(ratio=1e-9)
    for z in (1.0, 2.0, 4.0):
        found = sensor_depth(np.full((9, 9), z, np.float32), config)
        assert found.deviation[4, 4] * z**2 == pytest.approx(0.0015 * z**2, rel=1e-5)


def test_nothing_is_believed_beside_edges_and_holes_or_out_of_range():
    z = np.full((60, 80), 2.0, np.float32)
    z[:, 40:] = 3.0
    z[30, 10] = 0.0
    z[:20, 60:] = 12.0
    found = sensor_depth(z, CONFIG)
    unknown = found.inverse_depth == 0
    assert np.nonzero(unknown[45])[0].tolist() == [38, 39, 40, 41]
    assert np.nonzero(unknown[30, :20])[0].tolist() == [9, 10, 11]
    assert unknown[:20, 60:].all()
    assert np.isinf(found.deviation[unknown]).all()


def test_noise_makes_no_edges():
    rng = np.random.default_rng(0)
    for z in (1.0, 4.0, 7.0):
        d = 1 / z + 0.0015 * rng.standard_normal((120, 160))
        found = sensor_depth((1 / d).astype(np.float32), CONFIG)
        assert (found.inverse_depth > 0).mean() > 0.99


def test_cells_are_averages_that_planes_do_not_shift():
    rng = np.random.default_rng(1)
    exact = sensor_depth(plane(0.001), CONFIG).at_cells(4, 8, 7, 9)
    u = 4 + 8 * np.arange(9) - 40
    np.testing.assert_allclose(exact.inverse_depth[3], 0.4 + 0.001 * u, rtol=1e-5)
    noisy = 1 / plane(0.001) + 0.0015 * rng.standard_normal((60, 80))
    cells = sensor_depth((1 / noisy).astype(np.float32), CONFIG).at_cells(4, 8, 7, 9)
    assert (cells.inverse_depth - exact.inverse_depth).std() < 0.0005
    inverse_depth, information = cells.tensors("cpu")
    assert inverse_depth.shape == information.shape == (7, 9)
    torch.testing.assert_close(information, torch.from_numpy(cells.deviation) ** -2.0)


def test_unknown_cells_have_no_information():
    z = np.full((60, 80), 2.0, np.float32)
    z[:, :40] = 0.0
    cells = sensor_depth(z, CONFIG).at_cells(4, 8, 7, 9)
    _, information = cells.tensors("cpu")
    assert (information[:, :5] == 0).all()
    assert (information[:, 6:] > 1e4).all()


def test_smaller_pictures_know_where_most_pixels_do():
    z = plane(0.001).copy()
    z[:, :11] = 0.0
    small = sensor_depth(z, CONFIG).resized(20, 15)
    assert (small.inverse_depth[:, :2] == 0).all()
    u = 4 * np.arange(20) + 1.5 - 40
    np.testing.assert_allclose(small.inverse_depth[7, 4:], 0.4 + 0.001 * u[4:], rtol=1e-4)
    assert np.isinf(small.deviation[:, 0]).all()
