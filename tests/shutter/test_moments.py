"""Points brought to one time from places that they were seen at, each at its own time."""

import numpy as np

from geogs.shutter.moments import Passage


def passage(readout: float) -> tuple[Passage, np.ndarray]:
    """Fifty points on paths of the fourth order, seen five times in lines of their own; and where
    they are at time 0."""
    rng = np.random.default_rng(0)
    paths = rng.normal(0, 1, (50, 2, 5))
    times = np.array([-0.07, -0.033, 0.0, 0.033, 0.066])
    lines = rng.uniform(-0.5, 0.5, (5, 50))
    when = times[:, None] + readout * lines
    plane = np.array(
        [[[np.polyval(x, t) for x in p] for p, t in zip(paths, row, strict=True)] for row in when]
    )
    return Passage(plane, lines, times), paths[:, :, -1]


def test_points_on_smooth_paths_come_to_their_places():
    seen, true = passage(0.027)
    np.testing.assert_allclose(seen.at_once(0.027), true, atol=1e-10)


def test_without_a_readout_the_middle_image_says_it():
    seen, _ = passage(0.02)
    np.testing.assert_array_equal(seen.at_once(0.0), seen.plane[2])
    assert np.abs(seen.at_once(0.0) - seen.at_once(0.02)).max() > 1e-3
