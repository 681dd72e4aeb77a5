"""Jobs of a join, done in this process."""

from collections.abc import Callable, Sequence
from typing import TypeVar, TypeVarTuple

Ts = TypeVarTuple("Ts")
R = TypeVar("R")


class OneProcess:
    """Does one job after the other, as ``geogs_fleet.workers.Workers``."""

    at_once = 1

    def map(self, stage: str, function: Callable[[*Ts], R], jobs: Sequence[tuple[*Ts]]) -> list[R]:
        """The results in the order of the jobs."""
        return [function(*job) for job in jobs]
