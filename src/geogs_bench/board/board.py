"""Runs the rows of the board and writes their scores."""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geogs.application.evaluate import evaluate
from geogs.application.result_settings import EvalSettings
from geogs.errors import GeogsError, InputError
from geogs.evaluation.pages.evaluation_page import Evaluation
from geogs.evaluation.surfaces.reconstruction_errors import ReconstructionScores
from geogs.gpu.installation import require_device
from geogs.guard.atomic import prepare_output_folder, write_text
from geogs.guard.documents import read_json
from geogs.threads import available_cores
from geogs_bench.bench_options import BenchOptions
from geogs_bench.board.board_record import BoardRecord, Outcome, RowRecord, read_board, write_board
from geogs_bench.board.commands import run_geogs
from geogs_bench.board.comparison import Difference, compare, markdown
from geogs_bench.board.footage import FootagePlace, find, frames_used, render
from geogs_bench.board.rows import FOOTAGE, KEPT, SEEDS, Row, rows
from geogs_bench.board.with_constant import Constant
from geogs_bench.machine import machine_name, program_version
from geogs_bench.results.record import read_dataclass, write_json
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.motion_scores import is_near

RECORD = "board.json"
_OUTCOME = "outcome.json"
_COMMIT = "commit.txt"
_OPTIONS = ("name", "data", "output", "scenes", "device", "against", "fresh", "constants")
_CORES_FOR_ONE = 2
"""Cores for each command that uses a GPU; a command without one gets one core."""
_SAMPLES = 50_000
"""Samples on each surface; the standard error of a ratio is below 0.2 points."""


_Job = tuple[Row, int]
"""A command with one seed."""


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
    changed: tuple[Constant, float] | None = None
    """A constant that has another value in every command."""
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
            found = [row for row in self.chosen if row.footage in places]
            jobs = [(row, seed) for row in found for seed in SEEDS]
            self._jobs = len(jobs)
            self._places = places
            beside = [(row, seed) for row, seed in jobs if not row.runs_alone]
            try:
                outcomes = dict(zip(beside, pool.map(self._outcome, beside), strict=True))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            outcomes |= {job: self._outcome(job) for job in jobs if job not in outcomes}
        measured = tuple(
            RowRecord(
                row.name,
                places[row.footage].result().title,
                f"geogs {row.command}",
                row.runs_alone,
                tuple(outcomes[row, seed] for seed in SEEDS),
            )
            for row in found
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
        row, seed = job
        folder = self.output / row.name / f"seed-{seed}"
        outcome = None if self.fresh else self._measured_before(folder)
        if outcome is None:
            prepare_output_folder(folder)
            outcome = self._measured(row, seed, folder)
            write_json(folder / _OUTCOME, outcome)
            write_text(folder / _COMMIT, self.commit)
        self._report(f"{row.name}, seed {seed}", outcome)
        return outcome

    def _measured(self, row: Row, seed: int, folder: Path) -> Outcome:
        """Run a command, and compare its result with the truth."""
        place = self._places[row.footage].result()
        start = seed if row.command.startswith("run") else 0
        result = folder / "result"
        # Split before formatting, as there may be spaces in a path.
        command = [word.format(**place.words) for word in row.command.split()]
        command += place.options.split()
        command += ["-o", str(result), "--device", self.device, "--seed", str(seed)]
        command += ["--start", str(start)] if start else []
        command += ["--overwrite", "--no-strict"]
        with tempfile.TemporaryDirectory() as scratch:
            # Compiled code would keep the usual value of a constant.
            is_compiled_anew = row.has_empty_cache or self.changed is not None
            caches = Path(scratch) if is_compiled_anew else None
            spent, last_line = run_geogs(command, folder / "log.txt", caches, self.changed)
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

    def _report(self, name: str, outcome: Outcome) -> None:
        with self._lock:
            self._done += 1
            passed = (time.perf_counter() - self._begin) / 60
            left = passed / self._done * (self._jobs - self._done)
            said = f"failed: {outcome.error}" if outcome.error else f"{outcome.seconds:.0f} s"
            counted = f"[{self._done}/{self._jobs}]"
            self.say(f"{counted} {name}: {said}; about {left:.0f} min left")


def board(
    options: BenchOptions, say: Callable[[str], None]
) -> tuple[BoardRecord, list[Difference]]:
    """Run the board with these options; return its record and the changes since an earlier one.

    Raises:
        InputError: an option is wrong, or the record cannot be read; found before anything is run.
        OutputError: the folder cannot be written.
    """
    before = None if options.against is None else read_board(options.against)
    opened = opened_board(options, say)
    done = opened.run()
    changes = [] if before is None else compare(before, done)
    write_text(opened.output / "board.md", markdown(done, changes))
    return done, changes


def opened_board(options: BenchOptions, say: Callable[[str], None]) -> Board:
    """The board with these options, before anything is run. Raises InputError, OutputError."""
    device = require_device(options.device)
    on_gpu = device.type == "cuda"
    _refuse_others(options)
    output = options.output or Path("out") / f"bench-{options.name}"
    chosen = _chosen(options.scenes, rows(on_gpu))
    prepare_output_folder(output)
    data = options.data and options.data.expanduser()
    return Board(
        output,
        str(device),
        data,
        chosen,
        on_gpu,
        options.fresh,
        say,
        program_version(),
        reference_seconds(),
    )


def _refuse_others(options: BenchOptions) -> None:
    """Raise InputError if an option is given that the board does not use."""
    usual = BenchOptions(options.name)
    for name in vars(usual):
        if name not in _OPTIONS and getattr(options, name) != getattr(usual, name):
            raise InputError(f"--{name.replace('_', '-')} is not for the board.")


def _chosen(names: str, known: Sequence[Row]) -> tuple[Row, ...]:
    """The rows of these names; all if none is named."""
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    if strangers := [name for name in wanted if name not in {row.name for row in known}]:
        raise InputError(
            f"the board has no row {strangers[0]}; choose of {', '.join(r.name for r in known)}."
        )
    return tuple(row for row in known if not wanted or row.name in wanted)


def reference_seconds() -> float:
    """Processor time of the computation in seconds, the least of a few rounds.

    A mix of sorting, products of matrices, functions of arrays and filters of images, none of it
    ours; so ratios to it hardly depend on the machine's speed or load.
    """
    return min(_once() for _ in range(3))


def _once() -> float:
    random = np.random.default_rng(0)
    numbers = random.random(2_000_000, np.float32)
    matrices = random.random((64, 160, 160), np.float32)
    picture = random.integers(0, 256, (960, 1280, 3), np.uint8)
    rows = numbers[: 640 * 480].reshape(480, 640) * 900
    columns = numbers[-640 * 480 :].reshape(480, 640) * 900
    start = time.thread_time()
    for _ in range(2):
        order = np.argsort(numbers, kind="stable")
        np.exp(-numbers[order]).cumsum()
        (matrices @ matrices.transpose(0, 2, 1)).sum()
        for _ in range(4):
            cv2.GaussianBlur(picture, (9, 9), 2.0)
            cv2.remap(picture, rows, columns, cv2.INTER_LINEAR)
    return time.thread_time() - start


def with_scores(outcome: Outcome, folder: Path, truth: Path, frames: int) -> Outcome:
    """Add the errors of the result in ``folder``, whose sequence has ``frames``, to an outcome.

    Raises:
        InputError: the result or the truth cannot be read.
    """
    summary = ResultFolder(folder).summary
    found = _evaluated(folder, truth)
    errors = found.trajectory
    figures: dict[str, Any] = {
        "placed": 100 * errors.pairs / frames,
        "ate": errors.ate_rmse_cm,
        "disks": summary.get("disks"),
        "triangles": summary.get("mesh_faces"),
        **_surface_figures(found, ""),
    }
    is_called_reliable = (summary.get("verdict") or {}).get("is_reliable")
    if is_called_reliable is not None:
        is_off = not is_near(errors.ate_rmse_cm, errors.truth)
        figures["reliable"] = float(is_called_reliable)
        figures["misjudged"] = float(is_called_reliable and is_off)
    if found.reliability is not None:
        figures["error_per_sigma"] = found.reliability.error_per_sigma
    online = folder / "online"
    if (online / "mesh.ply").is_file():  # the surface at the end of the stream
        figures |= _surface_figures(_evaluated(online, truth), "online_")
    return replace(outcome, **figures)


def _evaluated(folder: Path, truth: Path) -> Evaluation:
    """Evaluate like ``geogs eval``, without its pictures."""
    return evaluate(EvalSettings(output=folder, gt=truth, samples=_SAMPLES, plots=False))


def _surface_figures(found: Evaluation, prefix: str) -> dict[str, float]:
    """Errors of the surface by the names of an outcome; empty if there is none to compare."""
    scores = found.reconstruction
    if scores is None:
        return {}
    if not isinstance(scores, ReconstructionScores):
        raise InputError("the board compares surfaces by area.")
    return {
        f"{prefix}accuracy": scores.accuracy_cm,
        f"{prefix}completeness": scores.completeness_ratio,
        f"{prefix}f_score": scores.f_score,
    }
