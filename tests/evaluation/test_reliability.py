"""Observed parts of the frames against drawn errors and against a loop."""

import numpy as np
import pytest
from scipy.stats import chi2

from geogs.evaluation.pages.plots import plot_reliability
from geogs.evaluation.reliability import LEVELS, Reliability, reliability


def drawn(factor: float, count: int = 40_000) -> Reliability:
    """Errors ``factor`` times as large as said, with deviations that differ."""
    random = np.random.default_rng(0)
    sigma = random.uniform(0.5, 3, count)
    error = factor * sigma[:, None] / 3**0.5 * random.normal(size=(count, 3))
    return Reliability(np.linalg.norm(error, axis=1), sigma)


def test_errors_as_foretold_lie_on_the_diagonal():
    told = drawn(1.0)
    levels = np.linspace(0.02, 0.98, 33)
    np.testing.assert_allclose(told.observed(levels), levels, atol=0.01)
    assert told.error_per_sigma == pytest.approx(1, abs=0.01)
    assert told.within_two_sigma == pytest.approx(chi2.cdf(12, 3), abs=0.002)


def test_larger_errors_lie_below_it_and_smaller_ones_above():
    level = np.array([0.5])
    assert drawn(3.0).observed(level) < 0.1
    assert drawn(0.3).observed(level) > 0.98
    assert drawn(3.0).error_per_sigma == pytest.approx(3, rel=0.02)


def test_observed_parts_are_those_of_a_loop_over_the_frames():
    told = drawn(1.7, 300)
    said = told.as_dict()
    assert said["foretold"] == list(LEVELS)
    for level, observed in zip(LEVELS, said["observed"], strict=True):
        inside = 0
        for error, sigma in zip(told.error, told.sigma, strict=True):
            radius = sigma / 3**0.5 * chi2.ppf(level, 3) ** 0.5
            inside += error <= radius
        assert observed == pytest.approx(inside / 300)


def test_deviations_are_those_of_the_nearest_frame_and_unknown_ones_take_no_part():
    at, sigma = np.array([0.0, 1, 2, 3]), np.array([1.0, 2, np.inf, 4])
    told = reliability(np.array([0.1, 0.9, 2.1, 2.9]), np.array([3.0, 3, 3, 3]), at, sigma)
    assert told is not None
    assert told.sigma.tolist() == [1, 2, 4]
    assert told.within_two_sigma == pytest.approx(2 / 3)
    assert reliability(np.ones(2), np.ones(2), at, np.full(4, np.inf)) is None
    assert reliability(np.ones(2), np.ones(2), at[:0], sigma[:0]) is None


def test_the_diagram_is_drawn(tmp_path):
    plot_reliability(tmp_path / "reliability.png", drawn(1.5, 50))
    assert (tmp_path / "reliability.png").read_bytes().startswith(b"\x89PNG")
