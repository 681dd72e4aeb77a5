"""The fusion of searched and measured depth."""

import math

import pytest
import torch

from geogs.depth.depth_view import DenseDepth
from geogs.mapping.keyframe_depths import fused_with_sensor


def searched(depth: float, confidence: float) -> DenseDepth:
    return DenseDepth(
        torch.full((2, 3), depth), torch.full((2, 3), confidence), torch.tensor(depth)
    )


def measured(depth: float, deviation: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A constant depth with its relative deviation; nothing in the first column."""
    inverse, information = (
        torch.full((2, 3), 1 / depth),
        torch.full((2, 3), (depth / deviation) ** 2),
    )
    information[:, 0] = 0
    return inverse, information


def test_where_nothing_was_measured_the_search_stands():
    found = fused_with_sensor(searched(2.0, 0.7), *measured(3.0, 0.005))
    assert (found.depth[:, 0] == 2.0).all()
    assert (found.confidence[:, 0] == 0.7).all()


def test_what_agrees_is_averaged_by_variances():
    # A confidence of 0.5 is that of the deviation whose errors are below 2 % half of the time.
    theirs = 0.02 / 0.6745
    found = fused_with_sensor(searched(2.02, 0.5), *measured(2.0, 0.01))
    share = 0.01**2 / (0.01**2 + theirs**2)
    assert float(found.depth[0, 1]) == pytest.approx(2.0 + share * 0.02, rel=1e-4)
    deviation = 1 / math.hypot(1 / 0.01, 1 / theirs)
    chance = math.erf(0.02 / (math.sqrt(2) * deviation))
    assert float(found.confidence[0, 1]) == pytest.approx(chance, rel=1e-3)


def test_a_search_that_is_far_off_is_left():
    found = fused_with_sensor(searched(3.0, 0.9), *measured(2.0, 0.01))
    assert (found.depth[:, 1:] == 2.0).all()
    assert float(found.median) == 2.0


def test_unsure_measurements_say_so():
    found = fused_with_sensor(searched(2.0, 0.01), *measured(2.0, 0.05))
    assert float(found.confidence[0, 1]) == pytest.approx(math.erf(0.02 / 0.05 / 2**0.5), rel=0.02)
    sure = fused_with_sensor(searched(2.0, 0.01), *measured(2.0, 0.001))
    assert float(sure.confidence[0, 1]) == pytest.approx(0.98)
