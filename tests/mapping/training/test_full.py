"""The order in which the long training goes through the keyframes."""

import numpy as np
import pytest

from geogs.mapping.training.full import random_order


@pytest.mark.parametrize("count", [1, 128, 129, 300])
def test_every_keyframe_comes_once(count: int) -> None:
    order = random_order(count, np.random.default_rng(1))
    assert sorted(order.tolist()) == list(range(count))


def test_of_many_keyframes_neighbours_come_together() -> None:
    random = np.random.default_rng(2)
    few, many, again = (
        random_order(128, random),
        random_order(640, random),
        random_order(640, random),
    )
    # The mean distance of two numbers below n is n / 3, of two of a block of 32 a third of that.
    assert np.abs(np.diff(few)).mean() > 30
    assert np.abs(np.diff(many)).mean() < 25
    # From one round to the next the blocks end elsewhere, and nothing keeps its place.
    assert (many == again).mean() < 0.05
    assert np.abs(np.corrcoef(many, again)[0, 1]) < 0.5
