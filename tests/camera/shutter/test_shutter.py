"""When a readout that was found is believed, and what is left open where it is not."""

import numpy as np
import pytest

from geogs.camera.shutter.shutter import LONGEST, SHORTEST, FoundReadout


@pytest.mark.parametrize(
    ("best", "error"), [(0.0, float("inf")), (0.001, 0.002), (0.009, 0.004), (0.045, 0.012)]
)
def test_what_is_left_open_is_the_mean_square_over_shutters_that_say_the_same(best, error):
    """Against shutters drawn, half of them global, and what noisy matches say of each."""
    rng = np.random.default_rng(0)
    true = rng.uniform(SHORTEST, LONGEST, 2_000_000) * rng.integers(0, 2, 2_000_000)
    said = true + rng.normal(0, error, len(true)) if np.isfinite(error) else 0 * true
    alike = true[np.abs(said - best) < 0.0003]
    assert len(alike) > 1000
    found = FoundReadout(best, error).left_open
    assert found == pytest.approx(np.sqrt((alike**2).mean()), rel=0.05)


def test_little_is_left_open_where_it_is_found_or_seen_to_be_none():
    assert FoundReadout().left_open == pytest.approx(0.0151, abs=1e-4)
    assert FoundReadout(0.02, 0.001).left_open == 0.001
    assert FoundReadout(-0.0005, 0.002).left_open < 0.0005
    assert FoundReadout(-0.005, 0.0001).left_open < 1e-6  # impossible, hence none


@pytest.mark.parametrize(
    ("best", "error", "is_believed"),
    [
        (0.0216, 0.002, True),
        (0.0216, 0.0055, False),  # less than four standard errors
        (0.03, 0.0065, True),
        (0.03, 0.008, False),
        (0.0377, 0.0079, True),  # may be as long as any
        (0.0015, 0.0001, False),  # nothing to care about
        (0.05, 0.002, False),  # no camera takes so long
        (-0.0216, 0.002, False),
        (0.0, float("inf"), False),
    ],
)
def test_a_readout_is_believed_where_it_is_clear(best, error, is_believed):
    found = FoundReadout(best, error)
    assert found.is_believed == is_believed
    assert found.readout == (min(best, LONGEST) if is_believed else 0.0)
