"""The time that is left of a run, on what two runs on two cores reported, and when.

``fixtures/run_events.json`` has both: 60 frames of a synthetic room, by which the machine of
reference was chosen, and 150 of a kitchen, by which nothing was.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from geogs.application.progress.run_forecast import RunForecast, RunPlan
from geogs.config import Config, preset

RUNS = json.loads((Path(__file__).parents[2] / "fixtures" / "run_events.json").read_text())


class Played:
    """A forecast that hears what a run reported, by a clock of its own."""

    def __init__(self, plan: RunPlan, events: list, begin: float) -> None:
        self.now, self.events = begin, list(events)
        self.forecast = RunForecast(plan, lambda: self.now)

    def left_at(self, time: float) -> float:
        while self.events and self.events[0][0] <= time:
            self.now, kind, what, value = self.events.pop(0)
            if kind == "expect":
                self.forecast.expect(value)
            elif kind == "frame":
                self.forecast.frame(what, value)
            elif kind == "stage":
                self.forecast.stage(what, value)
            self.forecast.left()
        self.now = time
        return self.forecast.left()


def said(name: str, pace: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds into a run, those that are said to be left, and those that are."""
    events = [[pace * e[0], *e[1:]] for e in RUNS[name]["events"]]
    begin, end = events[0][0], events[-1][0]
    calibrates = any(e[2] == "calibration" for e in events)
    plan = RunPlan(Config(), RUNS[name]["frames"], False, calibrates, True)
    played = Played(plan, events, begin)
    times = np.arange(begin, end, 0.5 * pace)
    return times - begin, np.array([played.left_at(t) for t in times]), end - times


def test_a_map_of_fewer_pixels_is_expected_to_take_less():
    plans = [RunPlan(preset(name), 150, False, False, True) for name in ("fast", "default")]
    fast, default = (plan.seconds(40)["mapping"] for plan in plans)
    assert 0.2 < fast / default < 0.35


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize(("pace", "least"), [(0.5, 0.7), (1.0, 0.9), (2.0, 0.9)])
def test_from_a_tenth_on_most_is_within_half_of_the_truth(name, pace, least):
    """Also where the machine is half as fast, or twice as fast, which it has to find out."""
    times, left, truth = said(name, pace)
    late = (times > 0.1 * truth[0]) & (truth > 1)
    errors = np.abs(left / truth - 1)[late]
    assert (errors < 0.5).mean() > least
    assert (errors < 0.25).mean() > 0.5


@pytest.mark.parametrize("name", RUNS)
def test_it_does_not_jump(name):
    times, left, truth = said(name)
    assert np.abs(np.diff(left) + np.diff(times)).max() < 0.1 * truth[0]
    assert (left >= 0).all()


def test_what_was_not_planned_counts_for_itself_and_not_for_the_pace():
    now = [0.0]
    plan = RunPlan(Config(), 100, False, False, True)
    forecast = RunForecast(plan, lambda: now[0])
    expected = sum(plan.seconds(33).values())
    assert forecast.left() == pytest.approx(expected, rel=0.01)
    for second in range(101):
        now[0] = float(second)
        forecast.stage("features", second / 100)
        forecast.left()
    assert forecast.left() == pytest.approx(expected, rel=0.1)


def test_a_stage_that_was_held_up_goes_on_where_it_was():
    now = [0.0]
    plan = RunPlan(Config(), 100, False, False, True)
    forecast = RunForecast(plan, lambda: now[0])
    forecast.frame(100, 30)
    now[0] = 20.0
    forecast.stage("mapping", 0.0)
    for name, begin, end, seconds in (
        ("mapping", 0.0, 0.4, 20), ("compiling, once", 0.0, 1.0, 30), ("mapping", 0.4, 0.5, 5),
    ):  # fmt: skip
        for part in np.linspace(begin, end, 21):
            now[0] += seconds / 21
            forecast.stage(name, float(part))
            forecast.left()
        if name == "compiling, once":
            assert forecast.left() == pytest.approx(30 + 6, abs=6)  # of mapping, and the mesh
    assert forecast.left() == pytest.approx(25 + 6, abs=6)


def test_a_run_that_goes_on_expects_only_what_is_left():
    now = [0.0]
    plan = RunPlan(Config(), 1000, False, False, True)
    forecast = RunForecast(plan, lambda: now[0])
    forecast.expect(900)
    for frame in range(901, 951):
        now[0] += 0.12
        forecast.frame(frame, frame // 4)
    seconds = plan.seconds(250)
    after = sum(seconds.values()) - seconds["frames"] - seconds["shutter"]
    assert forecast.left() == pytest.approx(after, rel=0.2)
