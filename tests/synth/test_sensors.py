"""Depth as a sensor measures it."""

import numpy as np

from geogs_synth.camera.sensors import DepthSensor

SENSOR = DepthSensor()


def wall(z: float) -> np.ndarray:
    return np.full((120, 160), z, np.float32)


def test_errors_grow_with_the_square_of_depth():
    spread = [SENSOR.measure(wall(z), 200.0, 0, 0).std() for z in (1.0, 2.0, 4.0)]
    expected = np.hypot(0.0015, 0.0028 / 12**0.5) * np.array([1, 4, 16])
    np.testing.assert_allclose(spread, expected, rtol=0.1)


def test_the_same_frame_has_the_same_noise():
    one, same, other = (SENSOR.measure(wall(2.0), 200.0, 3, k) for k in (5, 5, 6))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_holes_at_edges_beyond_the_range_and_where_surfaces_are_grazed():
    z = wall(2.0)
    z[:, 80:], z[:40, :40], z[90:, :40] = 3.0, 6.0, 0.2
    found = SENSOR.measure(z, 200.0, 0, 0)
    assert (found[5:35, 5:35] == 0).all()
    assert (found[95:, 5:35] == 0).all()
    assert 0.3 < (found[45:85, 79:81] == 0).mean() < 0.7
    assert (found[45:85, 90:] > 0).all()
    floor = np.broadcast_to(1 / (0.02 + 0.004 * np.arange(120))[:, None], (120, 160))
    lost = SENSOR.measure(floor.astype(np.float32), 200.0, 0, 0) == 0
    assert lost[:30].mean() > 0.9  # beyond 5 m
    grazed = DepthSensor(grazing=60.0, far=60.0).measure(floor.astype(np.float32), 200.0, 0, 0) == 0
    assert grazed[40:110].all()
