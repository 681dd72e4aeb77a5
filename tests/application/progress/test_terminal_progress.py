"""What a command says: one line on a terminal, lines of text without, and a log."""

import io
import logging
import os
import re
from pathlib import Path

import pytest
from rich.console import Console

from geogs.application.progress import terminal_progress
from geogs.application.progress.terminal_progress import TerminalProgress
from geogs.application.run_settings import Verbosity
from geogs.errors import OutputError
from geogs.pose_estimate import PoseEstimate
from geogs.world.segments import TrackState


def status(frames: int) -> PoseEstimate:
    return PoseEstimate(TrackState.TRACKING, frames, frames // 2, 1500)


def a_run(progress: TerminalProgress) -> None:
    progress.stage("calibration", 0.5)
    progress.expect(4)
    for number in range(1, 5):
        progress.frame(status(number))
    progress.write("Something happened at [1, 2].")
    progress.write("warning: too dark.")
    progress.stage("mesh: fuse", 0.5)


def test_without_a_terminal_every_phase_is_a_line(capsys):
    with TerminalProgress() as progress:
        a_run(progress)
    said = re.sub(r"\d+\.\d GB", "1 GB", capsys.readouterr().err).splitlines()
    assert said == [
        "calibration: 0 s",
        "Something happened at [1, 2].",
        "warning: too dark.",
        "frames: 0 s, 2 keyframes  1.5k disks  1 GB",
        "mesh: 0 s",
    ]


def test_dropped_frames_are_said_once_and_counted(capsys):
    with TerminalProgress() as progress:
        progress.expect(None)
        for number, dropped in ((1, 3), (2, 17)):
            progress.dropped(dropped)
            progress.frame(status(number))
    warning, line = capsys.readouterr().err.splitlines()
    assert warning.startswith("warning: frames come faster than they are tracked")
    assert "1 keyframes  1.5k disks  17 dropped" in line


def test_quiet_leaves_warnings(capsys):
    with TerminalProgress(Verbosity(quiet=True)) as progress:
        a_run(progress)
    assert capsys.readouterr().err == "warning: too dark.\n"


def test_nothing_is_said_where_nothing_happened(capsys, tmp_path):
    with TerminalProgress():
        pass
    assert capsys.readouterr().err == ""


def test_log_holds_everything_with_the_time_of_day(capsys, tmp_path):
    log = tmp_path / "new" / "run.log"
    with TerminalProgress(Verbosity(quiet=True, log=log)) as progress:
        a_run(progress)
    with pytest.raises(ValueError, match="wrong"), TerminalProgress(Verbosity(log=log)):
        raise ValueError("wrong")
    lines = log.read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d \S", line) for line in lines)
    assert lines[1].endswith("Something happened at [1, 2].")
    assert lines[-1].endswith("ended by ValueError: wrong")
    assert len(lines) == 6


def test_a_log_that_cannot_be_written_is_a_sentence(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        TerminalProgress(Verbosity(log=tmp_path)).__enter__()


def test_a_log_on_a_full_disk_ends_nothing(capsys, monkeypatch):
    monkeypatch.setattr(logging, "raiseExceptions", False)  # as the command has it
    with TerminalProgress(Verbosity(quiet=True, log=Path("/dev/full"))) as progress:
        a_run(progress)
    assert capsys.readouterr().err == "warning: too dark.\n"


def test_a_terminal_shows_one_line_with_the_time_left(monkeypatch):
    shown, now = io.StringIO(), [100.0]

    def console(**options) -> Console:
        return Console(
            file=shown, force_terminal=True, width=120, highlight=False, get_time=lambda: now[0]
        )

    monkeypatch.setattr(terminal_progress, "Console", console)
    with TerminalProgress() as progress:
        progress.stage("depth", 0.9)
        for fraction in (0.0, 0.1, 0.3, 0.5):
            now[0] += 30.0
            progress.stage("training", fraction)
        progress._bar.refresh()
        line = shown.getvalue().split("\r")[-1]
        assert "training" in line
        assert "50%" in line
        assert re.search(r"about 1 min 1\d s left", line)
    words = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.getvalue())
    assert os.linesep * 2 not in words


@pytest.mark.parametrize(
    ("phase", "number", "later"),
    [("calibration", "1/3", "then frames, mesh"), ("mesh", "3/3", ""), ("compiling", "", "")],
)
def test_the_stages_to_come_are_named_from_the_start(monkeypatch, phase, number, later):
    shown = io.StringIO()
    monkeypatch.setattr(
        terminal_progress,
        "Console",
        lambda **_: Console(file=shown, force_terminal=True, width=140, highlight=False),
    )
    with TerminalProgress() as progress:
        progress.stages(("calibration", "frames", "mesh"))
        progress.stage(phase, 0.25)
        progress._bar.refresh()
        line = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.getvalue().split("\r")[-1])
    assert line.strip().startswith(" ".join(filter(None, (number, phase))))
    assert ("then" in line) is bool(later)
    assert later in " ".join(line.split())


def test_without_a_terminal_the_stages_are_a_line(capsys):
    with TerminalProgress() as progress:
        progress.stages(("frames", "mesh"))
        progress.stages(())
    assert capsys.readouterr().err == "Stages: frames, mesh.\n"
