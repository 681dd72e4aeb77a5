"""The board: its sequences, what a command took, what counts as worse, and a row end to end."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest

from geogs.cli import main as cli
from geogs.errors import InputError, OutputError
from geogs.io.sources.sniff import open_source
from geogs_bench.bench_options import BenchOptions
from geogs_bench.board import board as board_module
from geogs_bench.board import footage as footage_module
from geogs_bench.board.board_record import BoardRecord, Outcome, RowRecord, read_board, write_board
from geogs_bench.board.commands import Spent, run_geogs
from geogs_bench.board.comparison import FIGURES, compare, markdown
from geogs_bench.board.footage import Footage, KeptFootage, Size, find, frames_used, render
from geogs_bench.board.rows import FOOTAGE, KEPT, SEEDS, Row, rows
from geogs_bench.board.sensitivity import sensitivity, table

TINY = Size(10, 96, 72)


def a_board(*rows: RowRecord) -> BoardRecord:
    return BoardRecord("abc", "a machine", "cpu", 0.7, 2, rows)


def a_row(*outcomes: Outcome, name: str = "room") -> RowRecord:
    return RowRecord(name, "handheld", "geogs run {folder}", False, outcomes)


def with_ate(*values: float) -> RowRecord:
    return a_row(*(Outcome(ate=value) for value in values))


@pytest.mark.parametrize("on_gpu", [False, True])
def test_every_row_has_its_footage_and_a_name_of_its_own(on_gpu):
    known = [footage.name for footage in (*FOOTAGE, *KEPT)]
    listed = rows(on_gpu)
    assert len({row.name for row in listed}) == len(listed)
    assert {row.footage for row in listed} <= set(known)
    assert len(set(known)) == len(known)
    alone = [row.runs_alone for row in listed]
    assert alone == sorted(alone)  # last, when nothing is beside them


def test_the_rows_hold_what_users_do():
    commands = " ; ".join(row.command for on_gpu in (False, True) for row in rows(on_gpu))
    for words in ("--preset fast", "--preset accurate", "--preset paper", "--online-results",
                  "--sfm", "--tracking.operator own", "run play:", "run {video}",
                  "reconstruct {folder} --budget"):  # fmt: skip
        assert words in commands
    assert any(row.has_empty_cache for row in rows(False))


def test_a_pause_of_the_camera_takes_frames_with_their_times(tmp_path, monkeypatch):
    footage = Footage("weak", "handheld-5hz", "clean", 3, TINY, TINY, gap=(0.4, 0.7))
    said: list[str] = []
    place = render(footage, tmp_path, False, said.append)
    assert place.frames == 7
    times = [frame.timestamp for frame in open_source((place.folder,))]
    assert times == pytest.approx([0.0, 0.2, 0.4, 0.6, 1.4, 1.6, 1.8])
    assert said == ["rendering weak"]
    assert render(footage, tmp_path, False, said.append) == place
    assert len(said) == 1  # what is there is not made again
    (place.folder / "footage.txt").write_text("another by now")
    failed = Spent(2, 0.0, 0.0, 0), "error: no"
    monkeypatch.setattr(footage_module, "run_geogs", lambda *_: failed)
    with pytest.raises(OutputError, match="weak cannot be rendered: error: no"):
        render(footage, tmp_path, False, said.append)


def test_a_data_set_that_is_not_there_is_none(tmp_path):
    footage = KeptFootage("kitchen", "seven/seq-01", "--stop 2 --long-edge 64")
    assert find(footage, None, False) is None
    assert find(footage, tmp_path, False) is None
    folder = tmp_path / "seven" / "seq-01"
    folder.mkdir(parents=True)
    rows = "\n".join(f"{t} {t} 0 0 0 0 0 1" for t in (0.0, 0.1, 0.2, 0.3))
    (folder / "groundtruth.txt").write_text(rows)
    place = find(footage, tmp_path, False)
    assert place is not None
    assert (place.frames, place.options) == (4, "--stop 2 --long-edge 64")


def test_what_a_command_took_is_that_of_its_process(tmp_path):
    log = tmp_path / "log.txt"
    held = bytearray(600_000_000)  # memory of this process is none of the command's
    held[::4096] = b"x" * len(held[::4096])
    spent, last_line = run_geogs(["--version"], log)
    del held
    assert spent.code == 0
    assert last_line.startswith("geogs ")
    assert 0 < spent.processor_seconds < 20
    assert 5e6 < spent.memory_bytes < 4e8
    assert log.read_text().startswith("$ geogs --version\n")
    failed, last_line = run_geogs(["run", "/nowhere"], log)
    assert failed.code == 2
    assert "/nowhere" in last_line


def test_an_empty_cache_is_a_folder_of_its_own(tmp_path):
    run_geogs(["--version"], tmp_path / "log.txt", tmp_path)
    names = sorted(
        folder.name.rsplit("-", 1)[0] for folder in tmp_path.iterdir() if folder.is_dir()
    )
    assert names == ["geogs_cache", "numba_cache_dir"]


@pytest.mark.parametrize(
    ("options", "used"),
    [("", 40), ("--stride 3", 14), ("--stride 3 --start 2", 13), ("--start 1 --stop 9", 8)],
)
def test_frames_that_are_used(options, used):
    assert frames_used(["run", "folder", *options.split(), "--seed", "0"], 40) == used


def test_what_is_worse_and_better_exceeds_the_noise():
    steady = with_ate(1.0, 1.1, 0.9)
    assert compare(a_board(steady), a_board(steady)) == []
    assert compare(a_board(steady), a_board(with_ate(1.2, 1.1, 1.3))) == []
    (worse,) = compare(a_board(steady), a_board(with_ate(2.0, 2.1, 1.9)))
    assert (worse.is_worse, worse.before, worse.now) == (True, 1.0, 2.0)
    # t = 4.6 times the pooled deviation 0.1 times the root of 2/3.
    assert worse.noise == pytest.approx(4.6 * 0.1 * (2 / 3) ** 0.5)
    assert str(worse) == "worse: room, ATE cm: 1.000 -> 2.000 (noise 0.376)"
    for another in ({"command": "geogs run {video}"}, {"footage": "walking"}):
        other = a_board(replace(steady, **another))
        assert compare(other, a_board(with_ate(2.0, 2.1, 1.9))) == []
    (better,) = compare(a_board(with_ate(2.0, 2.1, 1.9)), a_board(steady))
    assert not better.is_worse


def test_more_of_what_is_better_is_no_loss():
    def f(*values: float) -> BoardRecord:
        return a_board(a_row(*(Outcome(f_score=float(value)) for value in values)))

    (change,) = compare(f(90, 90, 90), f(91, 91, 91))
    assert not change.is_worse
    (change,) = compare(f(91, 91, 91), f(90, 90, 90))
    assert change.is_worse
    # What did not change from seed to seed still has the least difference that counts.
    assert compare(f(90, 90, 90), f(90.1, 90.1, 90.1)) == []


def test_seconds_count_on_the_same_machine_with_nothing_beside():
    def timed(seconds: float, alone: bool) -> BoardRecord:
        outcomes = (Outcome(seconds=seconds),) * 3
        return a_board(RowRecord("x", "handheld", "geogs run", alone, outcomes))

    slower = timed(20.0, True)
    assert [change.figure.name for change in compare(timed(10.0, True), slower)] == ["seconds"]
    assert compare(timed(10.0, True), replace(slower, machine="another")) == []
    assert compare(timed(10.0, False), timed(20.0, False)) == []


def test_a_command_that_fails_now_is_worse():
    broken = a_row(Outcome(ate=1.0), Outcome(error="no"), Outcome(error="no"))
    (change,) = compare(a_board(with_ate(1.0, 1.0, 1.0)), a_board(broken))
    assert change.is_worse
    assert "commands that failed: 0 -> 2" in str(change)


def test_a_record_is_read_as_it_was_written(tmp_path):
    board = a_board(a_row(Outcome(ate=0.1, disks=3), Outcome(error="why")))
    write_board(tmp_path / "board.json", board)
    assert read_board(tmp_path / "board.json") == board
    (tmp_path / "other.json").write_text("[1]")
    with pytest.raises(InputError, match=r"other\.json is no record of the board"):
        read_board(tmp_path / "other.json")


def test_the_table_has_a_cell_for_each_figure_and_the_reason_of_failures():
    board = a_board(a_row(Outcome(ate=0.1), Outcome(ate=0.3), Outcome(error="why")))
    lines = markdown(board, []).splitlines()
    (row,) = [line for line in lines if line.startswith("| room |")]
    assert row.count("|") == len(FIGURES) + 2
    assert "| 0.200 ± 0.141 |" in row
    assert "- room: why" in lines


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--variants", "a"], "--variants is not for the board"),
        (["--scenes", "attic"], "the board has no row attic; choose of paper, "),
        (["--against", "/nowhere.json"], "/nowhere.json"),
    ],
)
def test_what_the_board_cannot_do_is_a_sentence(arguments, sentence, tmp_path, capsys):
    call = ["bench", "board", "-o", str(tmp_path), "--device", "cpu", *arguments]
    assert cli.main(call) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert "Traceback" not in said


@pytest.mark.system
@pytest.mark.long  # a run in a process that compiles nothing: 40 s; its steps have tests above
def test_a_row_end_to_end(tmp_path, monkeypatch, capsys):
    footage = Footage("den", "handheld", "clean", 0, Size(30, 128, 96), TINY)
    quick = "--preset fast --mapping.final-iterations 20 --no-fallback"
    listed = (Row("good", "den", f"run {{folder}} --online-results {quick}"),
              Row("bad", "den", "run {folder} --stop 1", runs_alone=True))  # fmt: skip
    monkeypatch.setattr(board_module, "FOOTAGE", (footage,))
    monkeypatch.setattr(board_module, "rows", lambda on_gpu: listed)
    monkeypatch.setattr(board_module, "SEEDS", SEEDS[1:2])
    monkeypatch.setattr(board_module, "program_version", lambda: "abc")
    output = tmp_path / "my out"
    call = ["bench", "board", "-o", str(output), "--device", "cpu"]
    assert cli.main(call) == 2
    shown = capsys.readouterr()
    assert "[2/2] bad, seed 1: failed: error: " in shown.err
    board = read_board(output / "board.json")
    good, bad = board.rows
    assert len(bad.failures) == 1
    assert not good.failures
    assert good.values("placed") == pytest.approx([100.0])
    assert all(0.005 < value < 2 for value in good.values("ate"))
    assert all(30 < value < 100 for value in good.values("f_score"))
    assert len(good.values("online_f_score")) == 1
    assert good.values("f_score") != good.values("online_f_score")
    assert all(value > 1 for value in good.values("cost"))
    # Done at this commit: nothing runs again, and nothing is worse than itself.
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    again = [*call, "--scenes", "good", "--against", str(output / "board.json")]
    assert cli.main(again) == 0
    first = json.loads((output / "board.json").read_text())["rows"][0]
    assert first["outcomes"] == [vars(outcome) for outcome in good.outcomes]


def test_a_constant_is_changed_before_others_import_it(tmp_path):
    """A process with another value sees it in the module and where it was imported from there."""
    code = (
        "from geogs_bench.board.with_constant import Constant, change\n"
        "change(Constant.named('geogs.depth.revision.revised_searches:MIN_GAP'), 0.5)\n"
        "from geogs.depth.revision import revised_searches as owner\n"
        "print(owner.MIN_GAP)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0.5"]


def test_constants_are_halved_and_doubled_on_the_board(tmp_path, monkeypatch):
    """A row that gets worse is named; one that stays is flat."""
    seen = []

    def run(self):
        seen.append((self.output.name, self.changed and self.changed[1]))
        is_worse = self.changed is not None and self.changed[1] > 0.03
        return a_board(with_ate(*((2.0, 2.1, 2.05) if is_worse else (1.0, 1.1, 1.05))))

    monkeypatch.setattr(board_module.Board, "run", run)
    monkeypatch.setattr(board_module, "reference_seconds", lambda: 1.0)
    words = "geogs.depth.revision.revised_searches:MIN_GAP"
    options = BenchOptions("sensitivity", output=tmp_path, constants=(words,), device="cpu")
    (found,) = sensitivity(options, print)
    assert [value for _, value in seen] == [None, 0.015, 0.06]
    assert not found.is_flat
    assert "| flat | worse: room, ATE cm" in table([found])
    assert (tmp_path / "sensitivity.md").read_text() == table([found])


@pytest.mark.parametrize(
    ("constant", "message"),
    [
        ("geogs.depth.edges", "MODULE:NAME"),
        ("geogs.depth.edges:NONE", "does not exist"),
        ("geogs.depth.edges:__name__", "no single number"),
    ],
)
def test_what_is_no_constant_is_refused(constant, message, tmp_path):
    options = BenchOptions("sensitivity", output=tmp_path, constants=(constant,), device="cpu")
    with pytest.raises(InputError, match=message):
        sensitivity(options, print)
