"""The parts of the benchmark of a long walk that are not the walk."""

import pytest

from long_walk import last_against_first, to_and_fro


def test_a_walk_turns_back_where_its_images_end():
    assert [to_and_fro(n, 4) for n in range(10)] == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    assert [to_and_fro(n, 5) for n in range(5)] == list(range(5))
    assert to_and_fro(7, 1) == 0


def test_stages_are_held_against_what_they_took_at_first():
    first, last = {"tracking": 20.0, "mapping": 30.0}, {"tracking": 25.0, "loops": 2.0}
    found = last_against_first(first, last)
    assert found["tracking"] == [20.0, 25.0, pytest.approx(1.25)]
    assert found["loops"] == [0.0, 2.0, None]
