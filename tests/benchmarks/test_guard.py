"""The guard of costs: what it judges, and what it fails by."""

import json

import pytest

import guard
from guard import Costs, compare, read, verdict, write

BEFORE = Costs("some processor", 0.5, {"tracking": 10.0, "mesh": 4.0, "opening": 0.1})


def costs(**stages: float) -> Costs:
    return Costs("some processor", 0.7, BEFORE.stages | stages)


def slower(now: Costs) -> list[str]:
    return [finding.stage for finding in compare(BEFORE, now) if finding.is_slower]


def test_costs_that_stay_pass():
    assert slower(costs()) == []
    lines, is_good = verdict(BEFORE, costs())
    assert is_good
    assert len(lines) == 1 + 4


@pytest.mark.parametrize(("mesh", "fails"), [(5.1, False), (5.3, True), (0.1, False)])
def test_a_stage_fails_from_the_limit_on(mesh, fails):
    assert slower(costs(mesh=mesh)) == (["mesh"] if fails else [])


def test_a_short_stage_is_judged_once_it_is_long():
    assert slower(costs(opening=0.2)) == []
    assert slower(costs(opening=2.0)) == ["opening"]


def test_all_of_a_run_is_judged_with_what_is_new():
    assert slower(costs(dreaming=4.0)) == []
    assert slower(costs(dreaming=4.5)) == ["all"]


def test_a_stage_that_is_gone_fails():
    rest = {k: v for k, v in BEFORE.stages.items() if k != "mesh"}
    now = Costs("some processor", 0.5, rest)
    assert slower(now) == ["mesh"]
    lines, is_good = verdict(BEFORE, now)
    assert not is_good
    assert lines[-1] == "More than 1.3 times what was recorded: mesh."


def test_another_processor_is_said():
    other = Costs("another", 0.5, BEFORE.stages)
    lines, is_good = verdict(BEFORE, other)
    assert is_good
    assert lines[-1].startswith("note: recorded on some processor, this is another")


def test_a_record_comes_back(tmp_path):
    path = tmp_path / "guard.json"
    write(path, BEFORE, "abc1234")
    assert json.loads(path.read_text())["commit"] == "abc1234"
    assert read(path) == BEFORE


def test_the_record_in_the_repository_judges_what_matters():
    known = read(guard.RECORD)
    assert known.total > 1
    judged = {f.stage for f in compare(known, known) if f.is_judged}
    assert {"tracking", "final mapping", "mesh", "global bundle adjustment"} <= judged
