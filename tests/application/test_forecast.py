"""How long a stage still takes, told by a clock that the test turns."""

import pytest

from geogs.application.forecast import StageForecast


class Clock:
    """Time that passes when it is told to."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_stage_at_an_even_pace_ends_when_it_was_said():
    clock = Clock()
    forecast = StageForecast(clock)
    assert forecast.left("one", 0.0) is None  # nothing is known of the pace yet
    for part in range(1, 21):
        clock.now += 2
        assert forecast.left("one", part / 20) == pytest.approx(40 - 2 * part)


def test_each_stage_has_its_own_pace():
    clock = Clock()
    forecast = StageForecast(clock)
    forecast.left("one", 0.0)
    clock.now += 10
    assert forecast.left("one", 0.5) == pytest.approx(10)
    assert forecast.left("two", 0.0) is None
    clock.now += 4
    assert forecast.left("two", 0.2) == pytest.approx(16)


def test_a_slow_beginning_is_soon_forgotten():
    clock = Clock()
    forecast = StageForecast(clock)
    for frame in range(1, 61):
        clock.now += 5.0 if frame < 20 else 1.0
        left = forecast.left("frames", frame / 100)
    assert left == pytest.approx(40)


def test_nothing_is_said_of_a_source_without_a_length():
    clock = Clock()
    forecast = StageForecast(clock)
    for _ in range(3):
        clock.now += 1
        assert forecast.left("frames", None) is None
