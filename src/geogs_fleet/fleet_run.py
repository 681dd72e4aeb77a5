"""A fleet, from the names of its sources to its table."""

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from hashlib import sha256

from geogs.application.results.output_folder import only_writer
from geogs.application.run_settings import RunSettings
from geogs.errors import InputError
from geogs.io.writers.atomic import prepare_output_folder
from geogs_fleet.attempt import CHILD, FleetJob
from geogs_fleet.cluster import Allocation, allocation_for, ray_cluster
from geogs_fleet.fleet_options import FleetOptions
from geogs_fleet.fleet_progress import FleetProgress, Pace
from geogs_fleet.ray_schedule import rows_of
from geogs_fleet.row import FILE, Row, read_row
from geogs_fleet.sources import FleetSource, find_sources
from geogs_fleet.storage import StoragePath
from geogs_fleet.supervise import Limits
from geogs_fleet.table import write_table

_BETWEEN_TABLES = 5.0
"""Least time between two writings of the table, seconds."""


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
) -> FleetResult:
    """Compute every source that is not done yet, each into a folder of its name.

    A source that fails has a row with the reason. ``command`` is the program that computes one
    source, see :mod:`geogs_fleet.child`.

    Raises:
        InputError: no source is found, Ray is missing, or no machine has the requested resources.
        OutputError: the table cannot be written, or another fleet writes there.
        KeyboardInterrupt: after Ctrl-C; the table has been written.
    """
    progress, begin = progress or FleetProgress(), time.monotonic()
    sources = find_sources(settings.source)
    if not settings.output:
        raise InputError("The results need a folder; give one (-o).")
    output = StoragePath(settings.output).absolute()
    with _alone(output):
        digest = _digest(_run_settings(settings, "auto"))
        rows = {row.name: row for s in sources if (row := _done(output, s, digest)) is not None}
        missing = [source for source in sources if source.name not in rows]
        if missing:
            with ray_cluster(settings.address) as ray:
                allocation = allocation_for(ray, settings)
                jobs = [
                    _job(settings, source, output, allocation, digest, command)
                    for source in missing
                ]
                progress.begin(len(sources), len(rows), allocation.at_once)
                pace, written = Pace(len(jobs), allocation.at_once), -_BETWEEN_TABLES
                ended = rows_of(ray, jobs, allocation, settings.attempts)
                try:
                    for row in ended:
                        rows[row.name] = row
                        progress.ended(row, *pace.after_one(row.seconds))
                        if (now := time.monotonic()) >= written + _BETWEEN_TABLES:
                            _write(output, rows, sources, now - begin)
                            written = now
                finally:
                    ended.close()
                    _write(output, rows, sources, time.monotonic() - begin)
        else:
            _write(output, rows, sources, time.monotonic() - begin)
    return FleetResult(output.address, [rows[s.name] for s in sources], len(missing))


def _job(
    settings: FleetOptions,
    source: FleetSource,
    output: StoragePath,
    allocation: Allocation,
    digest: str,
    command: Sequence[str],
) -> FleetJob:
    return FleetJob(
        source,
        (output / source.name).address,
        _run_settings(settings, "cuda" if allocation.gpus else "cpu"),
        digest,
        Limits(settings.time_limit, allocation.memory),
        tuple(command),
        threads=allocation.cpus,
    )


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
    same = row is not None and (row.source, row.settings) == (source.address, digest)
    return row if same and row is not None and row.state == "done" else None


def _write(
    output: StoragePath, rows: dict[str, Row], sources: Sequence[FleetSource], seconds: float
) -> None:
    write_table(output, list(rows.values()), len(sources) - len(rows), seconds)


def _alone(output: StoragePath) -> AbstractContextManager[None]:
    """Lock a folder for this fleet, if it can have locks."""
    path = output.path
    return nullcontext() if path is None else only_writer(prepare_output_folder(path))
