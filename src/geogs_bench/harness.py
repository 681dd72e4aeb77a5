"""Runs and scores the jobs of a benchmark; a job that fails does not affect the others."""

import hashlib
import json
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.errors import GeogsError, InputError
from geogs.guard.atomic import prepare_output_folder, write_text
from geogs.guard.documents import UNUSABLE, read_json
from geogs_bench.benchmark import Benchmark
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.machine import forget_peak_memory, machine_name, program_version
from geogs_bench.plan import BenchmarkJob
from geogs_bench.results.record import (
    Cost,
    Provenance,
    Record,
    read_dataclass,
    read_record,
    write_json,
)
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.runners.runner import Runner
from geogs_bench.runners.task import Command
from geogs_bench.scoring.scores import scored
from geogs_bench.tables.benchmark_report import Chapter, write_report

_ERROR_FILE = "bench_error.txt"


RECORD_FILE = "bench.json"
"""The record of the result."""

_RUN_FILE = "bench_run.json"
_LEFT_BY_EARLIER_RUNS = (
    _RUN_FILE, RECORD_FILE, "mesh.ply", "map.safetensors", "summary.json", "online/trajectory.tum",
    "online/keyframes.tum", "online/mesh.ply", "adjusted/trajectory.tum",
    "adjusted/keyframes.tum", "adjusted/mesh.ply", "depth_fusion/mesh.ply", "snapshots/*/mesh.ply",
    "snapshots/*/map.safetensors",
)  # fmt: skip
"""Files of an earlier result that would be scored."""


@dataclass(frozen=True)
class CompletedRun:
    """A complete run: its source, provenance and cost."""

    source: str
    provenance: Provenance
    cost: Cost


def config_hash(command: Command, settings: Mapping[str, object]) -> str:
    """Twelve digits that change with any setting."""
    text = json.dumps([command, settings], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def completed_run(folder: Path, source: Path, digest: str) -> CompletedRun | None:
    """The run in a folder, if it is of this source with these settings."""
    try:
        run = read_dataclass(CompletedRun, read_json(folder / _RUN_FILE))
    except (InputError, *UNUSABLE):
        return None
    if not isinstance(run.provenance, Provenance):
        return None
    fits = run.source == str(source.resolve()) and run.provenance.config_hash == digest
    return run if fits else None


def write_completed_run(folder: Path, run: CompletedRun) -> None:
    """Mark the folder's run as complete. Raises OutputError if that fails."""
    write_json(folder / _RUN_FILE, run)


def clear(folder: Path) -> Path:
    """Prepare the folder for a new run: delete the files of an earlier one that would be scored.

    No other file is touched, and no link to another folder is followed.

    Raises:
        OutputError: it cannot be made or written.
    """
    prepare_output_folder(folder)
    for pattern in _LEFT_BY_EARLIER_RUNS:
        for path in folder.glob(pattern):
            if path.parent.resolve() == folder.resolve() / path.parent.relative_to(folder):
                path.unlink()
    return folder


def records_below(output: Path, benchmark: str) -> list[Record]:
    """The records of a benchmark in the folders of its results."""
    files = [*output.glob(f"*/{RECORD_FILE}"), *output.glob(f"*/*/{RECORD_FILE}")]
    records = [record for path in sorted(files) if (record := read_record(path)) is not None]
    return [record for record in records if record.benchmark == benchmark]


class Harness:
    """Runs one benchmark into one folder; finished jobs are not run again."""

    def __init__(
        self,
        benchmark: Benchmark,
        output: Path,
        runner: Runner,
        say: Callable[[str], None] = print,
        fresh: bool = False,
        rescore: bool = False,
    ) -> None:
        """``fresh`` runs all jobs again; ``rescore`` only scores them again."""
        self._benchmark = benchmark
        self._output = output
        self._runner = runner
        self._say = say
        self._fresh = fresh
        self._rescore = rescore
        self._commit = program_version()
        self._machine = machine_name()

    def run(
        self, jobs: Sequence[BenchmarkJob], report: Callable[[list[Record]], None] | None = None
    ) -> list[Record]:
        """Run jobs; return all records of the benchmark, with those of earlier calls in the folder.

        A job that fails leaves a record with the error, and the others go on. After each job
        ``report`` receives all records; without one they become a report in the folder.

        Raises:
            InputError: an option does not exist or fit; found before anything is run.
            OutputError: the folder cannot be written.
        """
        settings = self.check(jobs)
        report = report or self._write_report
        prepare_output_folder(self._output)
        records: list[Record] = []
        for number, (job, values) in enumerate(zip(jobs, settings, strict=True), start=1):
            name = f"{job.scene.name} {job.variant}".strip()
            self._say(f"[{number}/{len(jobs)}] {self._benchmark.name}: {name}")
            self._process(job, values)
            records = self.records(jobs)
            report(records)
        return records

    def check(self, jobs: Sequence[BenchmarkJob]) -> list[dict[str, object]]:
        """The settings of each job. Raises InputError where an option does not exist or fit."""
        return [self._runner.settings(job.task) for job in jobs]

    def _write_report(self, records: list[Record]) -> None:
        title = self._benchmark.title
        write_report(self._output, title, [Chapter(self._benchmark, records)])

    def records(self, jobs: Sequence[BenchmarkJob]) -> list[Record]:
        """Records of this benchmark in the folder, in the order of the jobs."""
        records = records_below(self._output, self._benchmark.name)
        scenes = [*self._benchmark.scenes, *(job.scene.name for job in jobs)]
        variants = [job.variant for job in jobs]

        def place(record: Record) -> tuple[int, str, int]:
            return _place(scenes, record.scene), record.scene, _place(variants, record.variant)

        return sorted(records, key=place)

    def _process(self, job: BenchmarkJob, settings: dict[str, object]) -> None:
        """Run and score a job, as far as necessary, and write its record."""
        folder = job.task.output
        digest = config_hash(job.task.command, settings)
        done = None if self._fresh else completed_run(folder, job.task.source, digest)
        before = read_record(folder / RECORD_FILE)
        is_scored = before is not None and before.error is None
        if done is not None and is_scored and not self._rescore:
            self._say("  done before")
            return
        provenance = Provenance(
            job.task.command, self._commit, self._machine, "", _seed(settings), digest
        )
        relative = str(folder.relative_to(self._output))
        record = Record(self._benchmark.name, job.scene.name, job.variant, relative, provenance)
        try:
            done = done or self._run(job, provenance)
            record = replace(record, provenance=done.provenance, cost=done.cost)
            self._say("  scoring")
            record = scored(record, job.scene, ResultFolder(folder))
        except GeogsError as error:
            record = replace(record, error=str(error))
        except Exception as error:  # whatever it is, the other scenes go on
            with suppress(GeogsError):
                write_text(folder / _ERROR_FILE, traceback.format_exc())
            why = " ".join(f"{type(error).__name__}: {error}".split())
            record = replace(record, error=f"{why} (see {relative}/{_ERROR_FILE})")
        if record.error is not None:
            self._say(f"  failed: {record.error}")
        write_json(folder / RECORD_FILE, record)

    def _run(self, job: BenchmarkJob, provenance: Provenance) -> CompletedRun:
        """Run a job; its folder is marked only once the run is complete."""
        folder = clear(job.task.output)
        forget_peak_memory()
        start = time.perf_counter()
        self._runner.run(job.task)
        seconds = time.perf_counter() - start
        result = ResultFolder(folder)
        if result.summary.get("interrupted"):
            raise KeyboardInterrupt  # the command has saved its state; the benchmark stops, too
        device = str(result.summary.get("device", "cpu"))
        provenance = replace(provenance, device=device)
        source = str(job.task.source.resolve())
        run = CompletedRun(source, provenance, cost_of(result, seconds))
        write_completed_run(folder, run)
        return run


def score_given(
    benchmark: Benchmark, scene: BenchmarkScene, folder: Path, output: Path
) -> list[Record]:
    """Score the result of an earlier command, with a report in ``output``; return its record.

    Raises:
        InputError: the result cannot be read or does not fit the scene.
        OutputError: the report cannot be written.
    """
    result = ResultFolder(folder.expanduser().resolve())
    prepare_output_folder(output)
    summary = result.summary
    seconds = float(summary.get("seconds", {}).get("total", 0.0))
    provenance = Provenance(
        benchmark.command,
        str(summary.get("versions", {}).get("geogs", "")),
        machine_name(),
        str(summary.get("device", "")),
        int(summary.get("seed", 0)),
        "",
    )
    record = Record(benchmark.name, scene.name, "", str(result.path), provenance)
    record = scored(replace(record, cost=cost_of(result, seconds)), scene, result)
    write_report(output, benchmark.title, [Chapter(benchmark, [record])])
    return [record]


def cost_of(result: ResultFolder, seconds: float) -> Cost:
    """Cost of a run, by its own summary; ``seconds`` are those of the whole command."""
    summary = result.summary
    rates = summary.get("frames_per_second", {})
    return Cost(
        seconds=round(seconds, 3),
        frames=summary.get("frames"),
        frames_per_second=rates.get("until_stream_end", rates.get("with_final_stages")),
        peak_memory_bytes=summary.get("peak_memory_bytes"),
        peak_gpu_memory_bytes=summary.get("peak_gpu_memory_bytes"),
        disks=summary.get("disks"),
        map_bytes=summary.get("map_bytes", result.map_bytes),
        stages=dict(summary.get("seconds", {})),
    )


def _seed(settings: Mapping[str, object]) -> int:
    seed = settings.get("seed", 0)
    return seed if isinstance(seed, int) else 0


def _place(order: Sequence[str], name: str) -> int:
    return order.index(name) if name in order else len(order)
