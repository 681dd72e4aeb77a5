"""Workers for the jobs of a join: tasks of a Ray cluster."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol, TypeVar, TypeVarTuple, runtime_checkable

from geogs.errors import DeviceError, GeogsError
from geogs_fleet.cluster import Allocation, as_task

Ts = TypeVarTuple("Ts")
R = TypeVar("R")


@runtime_checkable
class Workers(Protocol):
    """Runs independent jobs."""

    @property
    def at_once(self) -> int:
        """Number of jobs that can run at a time."""
        ...

    def map(self, stage: str, function: Callable[[*Ts], R], jobs: Sequence[tuple[*Ts]]) -> list[R]:
        """``function(*job)`` of every job, in their order; one result a job, however often tried.

        ``stage`` names the work in progress reports. Raises the errors of ``function``.
        """
        ...


class RayWorkers:
    """Runs jobs on a cluster, and repeats them if a node or a process is lost."""

    def __init__(
        self,
        ray: Any,
        allocation: Allocation,
        attempts: int,
        say: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """``allocation``: resources of each job; ``say`` receives a line for every stage."""
        self._ray = ray
        self._allocation = allocation
        self._attempts = attempts
        self._say = say

    @property
    def at_once(self) -> int:
        """Number of jobs that can run at a time."""
        return self._allocation.at_once

    def map(self, stage: str, function: Callable[[*Ts], R], jobs: Sequence[tuple[*Ts]]) -> list[R]:
        """Implements the protocol.

        Raises:
            GeogsError: as ``function`` raises it, or a job failed as often as it was tried.
        """
        begin = time.monotonic()
        ray = self._ray
        task = as_task(ray, function, self._allocation, retries=self._attempts - 1)
        references = [task(*job) for job in jobs]
        try:
            results: list[R] = _results(ray, references)
        except ray.exceptions.RayTaskError as error:
            raise (error.cause if isinstance(error.cause, GeogsError) else error) from error
        except ray.exceptions.RayError as error:
            raise DeviceError(
                f"{stage.capitalize()} failed {self._attempts} times, as the machine or the "
                "process was lost; is there enough memory?"
            ) from error
        self._say(f"{stage}: {len(jobs)} jobs, {time.monotonic() - begin:.1f} s")
        return results


def _results(ray: Any, references: Sequence[Any]) -> Any:
    """The results of all tasks; after an error or Ctrl-C the remaining tasks are cancelled."""
    try:
        return ray.get(references)
    except BaseException:
        for reference in references:
            with suppress(Exception):
                ray.cancel(reference, force=True)
        raise
