"""``--json`` gives one object whatever happens; the exit code says what is not reliable."""

import json
import logging
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from geogs.application.results.verdict import Verdict
from geogs.cli import export
from geogs.cli.answer import Answer, Record, wants_json, without_json
from geogs.cli.command import all_commands
from geogs.cli.main import main

RELIABLE = Verdict(True, "Trajectory and shape are reliable.", 0.0, 0.0, 0.01, 0.1, 0.02)
DOUBTFUL = replace(RELIABLE, is_reliable=False, sentence="Not reliable: all is lost.")


def said(capsys: pytest.CaptureFixture[str]) -> tuple[dict, str]:
    """The object on the standard output, and the standard error."""
    out, err = capsys.readouterr()
    assert out.count("\n") == 1
    return json.loads(out), err


@pytest.mark.parametrize("name", sorted({*all_commands()} - {"demo", "doctor", "ros2"}))
def test_every_command_answers_with_one_object(name, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = main([name, "--json", "--no-such-option"])
    found, err = said(capsys)
    assert (found["command"], found["exit_code"], code) == (name, 2, 2)
    assert "--no-such-option" in found["error"]
    assert err == f"error: {found['error']}\n"


@pytest.mark.parametrize("arguments", [["completion", "zsh"], ["weights"], ["download"], ["-V"]])
def test_a_command_without_values_gives_its_text(arguments, capsys):
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert main([*arguments, "--json"]) == 0
    found, _ = said(capsys)
    assert found["text"] == text.splitlines()
    assert found["warnings"] == []


def test_values_paths_and_warnings_are_in_the_object(monkeypatch, capsys):
    def answer(_: list[str]) -> Answer:
        logging.getLogger("geogs").warning("%d images are damaged.", 2)
        print("on the way")
        values = {"path": Path("a/b"), "error": math.nan, "rows": [1.5, math.inf]}
        return Answer("Done.", {**values, "warnings": ["no scale"]}, 3)

    monkeypatch.setattr(export, "main", answer)
    assert main(["export", "--json"]) == 3
    found, _ = said(capsys)
    assert found["warnings"] == ["2 images are damaged.", "no scale"]
    assert (found["path"], found["error"], found["rows"]) == ("a/b", None, [1.5, None])
    assert found["text"] == ["on the way", "Done."]


def test_a_file_may_have_the_name_of_the_option():
    assert without_json(["--json", "a", "--", "--json"]) == ["a", "--", "--json"]
    assert not wants_json(["a", "--", "--json"])
    assert json.loads(Record().text("", 0))["exit_code"] == 0


@pytest.fixture
def ends_with(monkeypatch, tmp_path):
    """Lets ``geogs run`` end with a verdict, at once."""
    (tmp_path / "summary.json").write_text('{"frames": 9, "verdict": {"is_reliable": false}}')

    def lets(verdict: Verdict | None) -> None:
        result = SimpleNamespace(
            folder=tmp_path, verdict=verdict, mesh=SimpleNamespace(faces=[0]), map=[0, 0],
            keyframes=SimpleNamespace(timestamps=[0.0]), is_interrupted=verdict is None,
            can_resume=False, source=None,
            scene=SimpleNamespace(frames=9, stopwatch=SimpleNamespace(total=1.0)),
        )  # fmt: skip
        monkeypatch.setattr("geogs.application.run.run", lambda *_, **__: result)
        monkeypatch.setattr("geogs.application.remedy.remedy", lambda *_: "")

    return lets


@pytest.mark.parametrize(
    ("verdict", "options", "code"),
    [
        (RELIABLE, [], 0), (RELIABLE, ["--strict"], 0), (DOUBTFUL, [], 3),
        (DOUBTFUL, ["--no-strict"], 0), (DOUBTFUL, ["-q"], 3), (None, [], 130),
    ],
)  # fmt: skip
def test_a_result_that_is_not_reliable_has_its_own_exit_code(
    ends_with, capsys, verdict, options, code
):
    ends_with(verdict)
    assert main(["run", "video.mp4", "--device", "cpu", *options]) == code
    out, err = capsys.readouterr()
    is_quiet = "-q" in options
    assert ("Results are in" in out) is not is_quiet
    assert (err == f"warning: {DOUBTFUL.sentence}\n") is is_quiet
    assert main(["run", "video.mp4", "--device", "cpu", "--json", *options]) == code
    found, _ = said(capsys)
    assert found["exit_code"] == code
    assert (found["frames"], list(found["files"])) == (9, ["summary.json"])
