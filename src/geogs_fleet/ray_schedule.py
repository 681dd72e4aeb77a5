"""The jobs of a fleet through Ray, repeated if a machine or a process fails.

The number of an attempt is stored in its row; Ray's own retries do not know it.
"""

from collections.abc import Generator, Iterable
from contextlib import suppress
from dataclasses import replace
from typing import Any

from geogs.errors import GeogsError
from geogs_fleet.attempt import FleetJob, attempt
from geogs_fleet.cluster import Allocation, as_task
from geogs_fleet.row import Row

_LOOK = 0.5
"""Seconds between two checks for jobs that have ended."""


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
            job.source.name, job.source.address, "crashed", _sentence(ray, error), job.digest,
            attempts=job.attempt,
        )  # fmt: skip


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
