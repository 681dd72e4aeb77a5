"""The jobs of a join as tasks of Ray, and again where a machine or a process failed."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from geogs.errors import DeviceError, GeogsError
from geogs_fleet.cluster import Share

J = TypeVar("J")
R = TypeVar("R")
_LOOK = 0.5
"""Seconds between two looks at what has ended."""


class RayWorkers:
    """Does jobs on a cluster; each has one result, the first that comes back."""

    def __init__(
        self,
        ray: Any,
        share: Share,
        attempts: int,
        say: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """``share`` is what each job gets of a node; ``say`` is told of every stage and retry."""
        self._ray, self._share, self._attempts, self._say = ray, share, attempts, say

    @property
    def at_once(self) -> int:
        """How many jobs can be done at a time."""
        return self._share.at_once

    def map(self, stage: str, function: Callable[[J], R], jobs: Sequence[J]) -> list[R]:
        """``function`` of every job, in their order.

        A job whose node or process fails is done again, up to ``attempts`` times in all.

        Raises:
            GeogsError: as ``function`` raises it, or a job failed as often as it was tried.
        """
        begin, share = time.monotonic(), self._share
        task = self._ray.remote(function).options(
            num_cpus=share.cpus,
            num_gpus=share.gpus or None,
            memory=share.memory,
            max_retries=0,
            scheduling_strategy="SPREAD",
        )
        tried = [1] * len(jobs)
        results: dict[int, R] = {}
        out = {task.remote(job): number for number, job in enumerate(jobs)}
        try:
            while out:
                ended, _ = self._ray.wait(list(out), num_returns=len(out), timeout=_LOOK)
                for reference in ended:
                    number = out.pop(reference)
                    try:
                        results.setdefault(number, self._ray.get(reference))
                    except self._ray.exceptions.RayTaskError as error:
                        raise _cause(error) from error
                    except self._ray.exceptions.RayError as error:
                        if tried[number] >= self._attempts:
                            raise DeviceError(
                                f"{stage.capitalize()} failed {tried[number]} times, as the "
                                "machine or the process was lost; is there enough memory?"
                            ) from error
                        self._say(f"{stage}: a machine or a process was lost; trying again.")
                        tried[number] += 1
                        out[task.remote(jobs[number])] = number
        finally:
            for reference in out:
                with suppress(Exception):
                    self._ray.cancel(reference, force=True)
        self._say(f"{stage}: {len(jobs)} jobs, {time.monotonic() - begin:.1f} s")
        return [results[number] for number in range(len(jobs))]


def _cause(error: Any) -> Exception:
    """What the function raised."""
    cause = getattr(error, "cause", None)
    return cause if isinstance(cause, GeogsError) else error
