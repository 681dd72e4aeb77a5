"""How long the rest takes, told by a clock that the test turns."""

import pytest

from geogs.application.forecast import RunForecast, StageForecast, mesh_stages
from geogs.config import preset
from geogs.stopwatch import Stopwatch


class Clock:
    """Time that passes when it is told to."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_stages_that_take_what_was_planned_end_when_it_was_said():
    clock = Clock()
    forecast = StageForecast([("one", 10.0), ("two", 30.0), ("three", 5.0)], clock)
    assert forecast.after_stage("one", 0.0) is None  # nothing is known of the pace yet
    clock.now += 5
    assert forecast.after_stage("one", 0.5) == pytest.approx(40)
    clock.now += 5
    assert forecast.after_stage("two: a part", 0.0) == pytest.approx(35)
    clock.now += 15
    assert forecast.after_stage("two", 0.5) == pytest.approx(20)
    assert forecast.after_stage("something else", 0.5) is None


def test_a_slower_machine_stretches_what_is_to_come():
    clock = Clock()
    forecast = StageForecast([("one", 1.0), ("two", 3.0)], clock)
    forecast.after_stage("one", 0.0)
    clock.now += 10
    assert forecast.after_stage("one", 1.0) == pytest.approx(30)
    forecast.after_stage("two", 0.0)
    clock.now += 20
    # Half by its own pace, 20 s, and half by that of all, 12 s for what was planned to take one.
    assert forecast.after_stage("two", 0.5) == pytest.approx(0.5 * 20 + 0.5 * 18)


def test_seconds_that_were_planned_hold_back_a_slow_beginning():
    clock = Clock()
    forecast = StageForecast([("one", 10.0), ("two", 90.0)], clock, trust=50.0)
    assert forecast.after_stage("one", 0.0) == pytest.approx(100)
    clock.now += 20
    pace = (20 + 50) / (1 + 50)
    assert forecast.after_stage("one", 0.1) == pytest.approx(0.9 * pace * 9 + 0.1 * 180 + pace * 90)


def test_a_stage_that_was_left_out_is_not_waited_for():
    clock = Clock()
    forecast = StageForecast([("one", 10.0), ("two", 10.0), ("three", 10.0)], clock)
    forecast.after_stage("one", 0.0)
    clock.now += 10
    forecast.after_stage("three", 0.0)
    clock.now += 5
    assert forecast.after_stage("three", 0.5) == pytest.approx(5)


@pytest.mark.parametrize(
    ("name", "at_the_end"), [("fast", False), ("default", False), ("default", True)]
)
def test_the_end_of_a_run_is_foreseen_from_a_third_on(name, at_the_end):
    """A run whose costs are those that were measured, with twice as slow final stages at worst."""
    clock, stopwatch, config = Clock(), Stopwatch(), preset(name)
    stopwatch.seconds = {"tracking": 0.0}
    forecast = RunForecast(config, stopwatch, 300, at_the_end, clock=clock)
    said: list[tuple[float, float]] = []

    def hear(left: float | None) -> None:
        if left is not None:
            said.append((clock.now, left))

    keyframes = 0
    for frame in range(1, 301):
        clock.now += 0.3
        stopwatch.seconds["tracking"] += 0.3
        if frame > 20 and frame % 5 == 0:  # a while passes before the first keyframe
            keyframes += 1
            if not at_the_end:
                clock.now += 4
                stopwatch.seconds["mapping"] = stopwatch.seconds.get("mapping", 0.0) + 4
        hear(forecast.after_frame(frame, keyframes))
    for stage, seconds in forecast.final_stages(keyframes, 1.0):
        for part in range(11):
            hear(forecast.after_stage(stage, part / 10))
            clock.now += 1.1 * seconds / 11
    begin, end = 100.0, clock.now
    late = [(now, left) for now, left in said if now > begin + (end - begin) / 3]
    assert len(late) > (40 if at_the_end else 150)
    for now, left in late:
        assert now + left - begin == pytest.approx(end - begin, rel=0.15)


def test_nothing_is_said_of_a_source_without_a_length():
    forecast = RunForecast(preset("fast"), Stopwatch(), None)
    assert forecast.after_frame(10, 3) is None


def test_stages_of_a_mesh_are_all_of_it():
    assert sum(seconds for _, seconds in mesh_stages(20.0)) == pytest.approx(20)
