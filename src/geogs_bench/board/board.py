"""Runs the rows of the board and writes their scores."""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from geogs.documents import read_json
from geogs.errors import GeogsError, InputError
from geogs.gpu.installation import require_device
from geogs.io.writers.atomic import prepare_output_folder, write_text
from geogs.threads import available_cores
from geogs_bench.bench_options import BenchOptions
from geogs_bench.board.board_record import (
    BoardRecord,
    Outcome,
    RowRecord,
    read_board,
    write_board,
)
from geogs_bench.board.board_table import markdown
from geogs_bench.board.commands import run_geogs
from geogs_bench.board.comparison import Difference, compare
from geogs_bench.board.footage import FootagePlace, find, frames_used, render
from geogs_bench.board.reference import reference_seconds
from geogs_bench.board.rows import FOOTAGE, KEPT, SEEDS, Row, rows
from geogs_bench.board.scores import with_scores
from geogs_bench.machine import machine_name, program_version
from geogs_bench.results.record import read_dataclass, write_json

RECORD = "board.json"
_OUTCOME = "outcome.json"
_COMMIT = "commit.txt"
_OPTIONS = ("name", "data", "output", "scenes", "device", "against", "fresh")
_CORES_FOR_ONE = 2
"""Cores for each command that uses a GPU; a command without one gets one core."""


@dataclass(frozen=True)
class _Job:
    """A command with one seed."""

    row: Row
    seed: int


@dataclass
class Board:
    """The chosen rows, on a device, into a folder."""

    output: Path
    device: str
    data: Path | None
    chosen: tuple[Row, ...]
    on_gpu: bool
    fresh: bool
    say: Callable[[str], None]
    commit: str
    unit: float
    """Seconds of the fixed computation."""
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _begin: float = 0.0
    _jobs: int = 0
    _places: dict[str, "Future[FootagePlace]"] = field(default_factory=dict)
    _done: int = 0

    def run(self) -> BoardRecord:
        """Run the commands that have not been run at this commit, and write the record.

        Raises:
            OutputError: the folder cannot be written.
        """
        self._begin = time.perf_counter()
        with ThreadPoolExecutor(self.side_by_side) as pool, self._rendering() as places:
            jobs = [
                _Job(row, seed) for row in self.chosen if row.footage in places for seed in SEEDS
            ]
            self._jobs = len(jobs)
            self._places = places
            beside = [job for job in jobs if not job.row.runs_alone]
            try:
                outcomes = dict(zip(beside, pool.map(self._outcome, beside), strict=True))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            outcomes |= {job: self._outcome(job) for job in jobs if job.row.runs_alone}
        measured = tuple(
            RowRecord(
                row.name,
                places[row.footage].result().title,
                f"geogs {row.command}",
                row.runs_alone,
                tuple(outcomes[_Job(row, seed)] for seed in SEEDS),
            )
            for row in self.chosen
            if row.footage in places
        )
        record = BoardRecord(
            self.commit,
            machine_name(),
            self.device,
            round(self.unit, 4),
            self.side_by_side,
            measured,
        )
        write_board(self.output / RECORD, record)
        self.say(f"{(time.perf_counter() - self._begin) / 60:.1f} minutes in all")
        return record

    @property
    def side_by_side(self) -> int:
        """Number of concurrent commands, of those that do not run alone."""
        return max(1, available_cores() // (_CORES_FOR_ONE if self.on_gpu else 1))

    @contextmanager
    def _rendering(self) -> Iterator[dict[str, "Future[FootagePlace]"]]:
        """Sequences of all rows, some still being rendered; missing data sets are reported."""
        wanted = {row.footage for row in self.chosen}
        found: dict[str, Future[FootagePlace]] = {}
        with ThreadPoolExecutor(self.side_by_side) as pool:
            for kept in (kept for kept in KEPT if kept.name in wanted):
                place = find(kept, self.data, self.on_gpu)
                if place is None:
                    self.say(f"left out: {kept.name}, as there is no {kept.folder}")
                else:
                    found[kept.name] = Future()
                    found[kept.name].set_result(place)
            root = prepare_output_folder(self.output / "footage")
            for footage in (footage for footage in FOOTAGE if footage.name in wanted):
                found[footage.name] = pool.submit(render, footage, root, self.on_gpu, self.say)
            yield found

    def _outcome(self, job: _Job) -> Outcome:
        """Run a command and measure its result, or read the earlier measurement."""
        folder = self.output / job.row.name / f"seed-{job.seed}"
        outcome = None if self.fresh else self._measured_before(folder)
        if outcome is None:
            prepare_output_folder(folder)
            outcome = self._measured(job, folder)
            write_json(folder / _OUTCOME, outcome)
            write_text(folder / _COMMIT, self.commit)
        self._report(job, outcome)
        return outcome

    def _measured(self, job: _Job, folder: Path) -> Outcome:
        """Run a command, and compare its result with the truth."""
        row = job.row
        place = self._places[row.footage].result()
        start = job.seed if row.command.startswith("run") else 0
        result = folder / "result"
        # Split before formatting, as there may be spaces in a path.
        command = [word.format(**place.words) for word in row.command.split()]
        command += place.options.split()
        command += ["-o", str(result), "--device", self.device, "--seed", str(job.seed)]
        command += ["--start", str(start)] if start else []
        with tempfile.TemporaryDirectory() as scratch:
            caches = Path(scratch) if row.has_empty_cache else None
            spent, last_line = run_geogs(command, folder / "log.txt", caches)
        outcome = Outcome(
            cost=spent.processor_seconds / self.unit,
            seconds=spent.seconds,
            memory=spent.memory_bytes / 1e6,
        )
        if spent.code:
            return replace(outcome, error=last_line or f"exit code {spent.code}")
        with self._lock:  # an evaluation uses all cores
            try:
                return with_scores(
                    outcome, result, place.folder, frames_used(command, place.frames)
                )
            except GeogsError as error:
                return replace(outcome, error=str(error))

    def _measured_before(self, folder: Path) -> Outcome | None:
        """The outcome of an earlier call at the same commit, if no file has changed since."""
        mark = folder / _COMMIT
        if self.commit.endswith("+") or not mark.is_file() or mark.read_text() != self.commit:
            return None
        return read_dataclass(Outcome, read_json(folder / _OUTCOME))

    def _report(self, job: _Job, outcome: Outcome) -> None:
        with self._lock:
            self._done += 1
            passed = (time.perf_counter() - self._begin) / 60
            left = passed / self._done * (self._jobs - self._done)
            said = f"failed: {outcome.error}" if outcome.error else f"{outcome.seconds:.0f} s"
            self.say(
                f"[{self._done}/{self._jobs}] {job.row.name}, seed {job.seed}: {said}; "
                f"about {left:.0f} min left"
            )


def board(
    options: BenchOptions, say: Callable[[str], None]
) -> tuple[BoardRecord, list[Difference]]:
    """Run the board with these options; return its record and the changes since an earlier one.

    Raises:
        InputError: an option is wrong, or the record cannot be read; found before anything is run.
        OutputError: the folder cannot be written.
    """
    device = require_device(options.device)
    on_gpu = device.type == "cuda"
    _refuse_others(options)
    before = None if options.against is None else read_board(options.against)
    output = options.output or Path("out") / "bench-board"
    chosen = _chosen(options.scenes, rows(on_gpu))
    prepare_output_folder(output)
    data = options.data and options.data.expanduser()
    done = Board(
        output,
        str(device),
        data,
        chosen,
        on_gpu,
        options.fresh,
        say,
        program_version(),
        reference_seconds(),
    ).run()
    changes = [] if before is None else compare(before, done)
    write_text(output / "board.md", markdown(done, changes))
    return done, changes


def _refuse_others(options: BenchOptions) -> None:
    """Raise InputError if an option is given that the board does not use."""
    usual = BenchOptions(options.name)
    for known in fields(BenchOptions):
        if known.name not in _OPTIONS and getattr(options, known.name) != getattr(
            usual, known.name
        ):
            raise InputError(f"--{known.name.replace('_', '-')} is not for the board.")


def _chosen(names: str, known: Sequence[Row]) -> tuple[Row, ...]:
    """The rows of these names; all if none is named."""
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    if strangers := [name for name in wanted if name not in {row.name for row in known}]:
        raise InputError(
            f"the board has no row {strangers[0]}; choose of {', '.join(r.name for r in known)}."
        )
    return tuple(row for row in known if not wanted or row.name in wanted)
