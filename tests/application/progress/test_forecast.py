"""The time that is left of a command, on what commands on two cores reported, and when.

``fixtures/time_left`` has them, as ``benchmarks/time_left.py`` keeps them: runs of 60 frames of a
synthetic room and of 150 of a phone (held in the hand, moved slowly, carried) with the default and
with ``--preset fast``, photographs that are placed offline, and reconstructions with and without
poses, most of them beside other programs.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from geogs.application.progress.forecast import Forecast
from geogs.application.progress.plan import PosedPlan, RunPlan
from geogs.config import Config, ReconstructConfig, preset
from time_left import said

FOLDER = Path(__file__).parents[2] / "fixtures" / "time_left"
COMMANDS = {path.stem: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))}
SIZE = 320, 240


def test_a_map_of_fewer_pixels_is_expected_to_take_less():
    plans = [RunPlan(preset(name), 150, SIZE, False, False, True) for name in ("fast", "default")]
    fast, default = (plan.seconds(40) for plan in plans)
    assert 0.2 < fast["depth"] / default["depth"] < 0.6
    assert 0.2 < fast["training"] / default["training"] < 0.6


@pytest.mark.parametrize("name", COMMANDS)
def test_of_each_command_most_is_near_the_truth_from_a_tenth_on(name):
    shown = said(COMMANDS[name])
    assert shown.within(0.5) > 0.7
    assert shown.within(0.25) > 0.3


@pytest.mark.parametrize("pace", [1.0, 2.0])
def test_of_all_commands_nine_tenths_are_within_half_and_six_within_a_quarter(pace):
    """Also where the machine takes twice as long, which it has to find out."""
    names = [name for name in COMMANDS if pace == 1 or not name.startswith("budget")]
    shown = [said(COMMANDS[name], pace) for name in names]
    assert np.mean([s.within(0.5) for s in shown]) > 0.9
    assert np.mean([s.within(0.25) for s in shown]) > 0.6


@pytest.mark.parametrize("name", COMMANDS)
def test_it_does_not_jump(name):
    shown = said(COMMANDS[name])
    jumps = np.abs(np.diff(shown.left) + np.diff(shown.times))
    assert np.quantile(jumps, 0.98) < 0.1 * shown.truth[0]
    assert (shown.left >= 0).all()


def test_what_was_not_planned_counts_for_itself_and_not_for_the_pace():
    now = [0.0]
    plan = RunPlan(Config(), 100, SIZE, False, False, True)
    forecast = Forecast(plan, lambda: now[0])
    expected = forecast.left()
    for second in range(101):
        now[0] = float(second)
        forecast.stage("features", second / 100)
        forecast.left()
    assert forecast.left() == pytest.approx(expected, rel=0.1)


def test_a_stage_that_was_held_up_goes_on_where_it_was():
    now = [0.0]
    plan = RunPlan(Config(), 100, SIZE, False, False, True)
    forecast = Forecast(plan, lambda: now[0])
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
            assert forecast.left() == pytest.approx(30 + 6, abs=10)  # of mapping, and the mesh
    assert forecast.left() == pytest.approx(25 + 6, abs=6)


def test_a_run_that_goes_on_expects_only_what_is_left():
    now = [0.0]
    plan = RunPlan(Config(), 1000, SIZE, False, False, True)
    forecast = Forecast(plan, lambda: now[0])
    forecast.expect(900)
    for frame in range(901, 951):
        now[0] += 0.12
        forecast.frame(frame, frame // 4)
    seconds = plan.seconds(250)
    after = sum(seconds.values()) - seconds["frames"]
    assert forecast.left() == pytest.approx(after, rel=0.2)


POSES = {"features": 5.0, "matching": 20.0, "finding poses": 15.0}


def budgeted(end: float) -> PosedPlan:
    return PosedPlan(ReconstructConfig(), 50, SIZE, False, POSES, end)


def test_what_is_given_is_what_is_left():
    now = [0.0]
    forecast = Forecast(budgeted(90.0), lambda: now[0])
    for stage, second in (("features", 2), ("matching", 20), ("depth", 50), ("training", 70)):
        now[0] = float(second)
        forecast.stage(stage, 0.1)
        assert forecast.left() == pytest.approx(90 - second, abs=5)


def test_where_poses_take_all_that_is_given_more_is_said_at_once():
    now = [0.0]
    forecast = Forecast(budgeted(30.0), lambda: now[0])
    assert forecast.left() == pytest.approx(40 + 17, abs=1)  # and the smallest map
    for second in range(41):
        now[0] = float(second)
        forecast.stage("features" if second < 5 else "matching", 0.0 if second < 5 else second / 50)
        forecast.left()
    assert forecast.left() > 15 + 15


def test_another_plan_goes_on_at_the_pace_of_the_machine():
    now = [0.0]
    plan = RunPlan(Config(), 100, SIZE, False, True, True)
    forecast = Forecast(plan, lambda: now[0])
    forecast.stage("calibration", 0.0)
    now[0] = 3 * plan.seconds(0)["calibration"]
    forecast.stage("calibration", 1.0)
    other = PosedPlan(ReconstructConfig(), 50, SIZE, False)
    forecast.change(other)
    for _ in range(20):
        now[0] += 1.0
        forecast.stage("reading", 0.0)
        forecast.left()
    assert forecast.left() > 1.5 * sum(other.seconds(0).values())
