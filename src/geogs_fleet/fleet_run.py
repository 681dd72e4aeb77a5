"""A fleet, from the names of its sources to its table.

Ray schedules the jobs; those whose machine or process fails are repeated here, as a row contains
the number of its attempt, which Ray's own retries do not know.
"""

import time
from collections.abc import Generator, Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any

from geogs.application.results.output_folder import only_writer
from geogs.application.run_settings import RunSettings
from geogs.config import Config
from geogs.errors import GeogsError, InputError
from geogs.guard.atomic import prepare_output_folder
from geogs_fleet.attempt import CHILD, FleetJob, attempt
from geogs_fleet.cluster import Allocation, allocation_for, as_task, ray_cluster
from geogs_fleet.fleet_options import FleetOptions
from geogs_fleet.fleet_progress import FleetProgress, Pace
from geogs_fleet.sources import FleetSource, find_sources
from geogs_fleet.storage import StoragePath
from geogs_fleet.supervise import Limits
from geogs_fleet.table import FILE, Row, read_row, write_table

_BETWEEN_TABLES = 5.0
"""Least time between two writings of the table, seconds."""
_LOOK = 0.5
"""Seconds between two checks for jobs that have ended."""


@dataclass(frozen=True)
class FleetResult:
    """Outcome of a fleet."""

    output: str
    rows: list[Row]
    """Rows of all sources, in their order."""
    computed: int
    """Number of sources computed this time; the others were done before."""


def run_fleet(
    settings: FleetOptions,
    progress: FleetProgress | None = None,
    command: Sequence[str] = CHILD,
    config_on_gpu: Config | None = None,
) -> FleetResult:
    """Compute every source that is not done yet, each into a folder of its name.

    A source that fails has a row with the reason.

    Args:
        settings: what to compute.
        progress: follows the work.
        command: program that computes one source, see :mod:`geogs_fleet.child`.
        config_on_gpu: replaces the settings' own ``config`` where sources are computed on GPUs.

    Raises:
        InputError: no source is found, Ray is missing, or no machine has the requested resources.
        OutputError: the table cannot be written, or another fleet writes there.
        KeyboardInterrupt: after Ctrl-C; the table has been written.
    """
    progress = progress or FleetProgress()
    begin = time.monotonic()
    sources = find_sources(settings.source)
    if not settings.output:
        raise InputError("The results need a folder; give one (-o).")
    output = StoragePath(settings.output).absolute()
    here = output.path
    alone = nullcontext() if here is None else only_writer(prepare_output_folder(here))
    with alone:
        digest = _digest(_run_settings(settings, "auto"))
        rows = {row.name: row for s in sources if (row := _done(output, s, digest)) is not None}
        missing = [source for source in sources if source.name not in rows]

        def write() -> None:
            seconds = time.monotonic() - begin
            write_table(output, list(rows.values()), len(sources) - len(rows), seconds)

        if missing:
            with ray_cluster(settings.address) as ray:
                allocation = allocation_for(ray, settings)
                if allocation.gpus and config_on_gpu is not None:
                    settings = replace(settings, config=config_on_gpu)
                run = _run_settings(settings, "cuda" if allocation.gpus else "cpu")
                limits = Limits(settings.time_limit, allocation.memory)
                jobs = [
                    FleetJob(
                        source,
                        (output / source.name).address,
                        run,
                        digest,
                        limits,
                        tuple(command),
                        threads=allocation.cpus,
                    )
                    for source in missing
                ]
                progress.begin(len(sources), len(rows), allocation.at_once)
                pace = Pace(len(jobs), allocation.at_once)
                written = -_BETWEEN_TABLES
                ended = rows_of(ray, jobs, allocation, settings.attempts)
                try:
                    for row in ended:
                        rows[row.name] = row
                        progress.ended(row, *pace.after_one(row.seconds))
                        if (now := time.monotonic()) >= written + _BETWEEN_TABLES:
                            write()
                            written = now
                finally:
                    ended.close()
                    write()
        else:
            write()
    return FleetResult(output.address, [rows[s.name] for s in sources], len(missing))


def _run_settings(settings: FleetOptions, device: str) -> RunSettings:
    return RunSettings(
        config=settings.config,
        device=device,
        checkpoint_every=settings.checkpoint_every,
        keyframe_images=settings.keyframe_images,
    ).absolute()


def _digest(settings: RunSettings) -> str:
    """Digest of the settings that determine a result; the checkpoints' interval does not."""
    deciding = replace(settings, checkpoint_every=60.0)
    return sha256(repr(deciding).encode()).hexdigest()[:16]


def _done(output: StoragePath, source: FleetSource, digest: str) -> Row | None:
    """The row of an earlier result of this source with these settings."""
    row = read_row((output / source.name / FILE).read())
    wanted = (source.address, digest, "done")
    return row if row and (row.source, row.settings, row.state) == wanted else None


def rows_of(
    ray: Any, jobs: Iterable[FleetJob], allocation: Allocation, attempts: int
) -> Generator[Row, None, None]:
    """Yield the row of every job, in the order in which they end; each job has exactly one.

    All jobs are submitted to Ray at once. A job whose node or process fails is submitted again, up
    to ``attempts`` times in all. When the caller stops iterating, the remaining jobs are cancelled.
    """
    task = as_task(ray, attempt, allocation)
    out: dict[Any, FleetJob] = {task(job): job for job in jobs}
    try:
        while out:
            ended, _ = ray.wait(list(out), num_returns=len(out), timeout=_LOOK)
            for reference in ended:
                job = out.pop(reference)
                row = _row(ray, reference, job)
                if row.state == "crashed" and job.attempt < attempts:
                    again = replace(job, attempt=job.attempt + 1)
                    out[task(again)] = again
                else:
                    yield replace(row, state="failed") if row.state == "crashed" else row
    finally:
        for reference in out:
            with suppress(Exception):  # also while the cluster shuts down
                ray.cancel(reference, force=True)


def _row(ray: Any, reference: Any, job: FleetJob) -> Row:
    """The row of a task, or that of a crash if Ray lost the task."""
    try:
        row: Row = ray.get(reference)
        return row
    except ray.exceptions.RayError as error:
        return Row(
            job.source.name,
            job.source.address,
            "crashed",
            _sentence(ray, error),
            job.digest,
            attempts=job.attempt,
        )


def _sentence(ray: Any, error: Exception) -> str:
    cause = getattr(error, "cause", None)
    if isinstance(cause, GeogsError):
        return str(cause)
    if isinstance(error, ray.exceptions.OutOfMemoryError):
        return "The memory of the machine was full; give fewer sources at once (--cpus, --gpus)."
    if isinstance(error, ray.exceptions.NodeDiedError | ray.exceptions.WorkerCrashedError):
        return "The machine or the process was lost."
    said = str(error).strip().splitlines() or [type(error).__name__]
    return f"Ray lost the task ({said[-1][:200]})."
