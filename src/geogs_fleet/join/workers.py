"""Who does the jobs of a join: this process, or others."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar, runtime_checkable

J = TypeVar("J")
R = TypeVar("R")


@runtime_checkable
class Workers(Protocol):
    """Does jobs that do not depend on each other."""

    @property
    def at_once(self) -> int:
        """How many jobs can be done at a time."""
        ...

    def map(self, stage: str, function: Callable[[J], R], jobs: Sequence[J]) -> list[R]:
        """``function`` of every job, in their order; each counts once, however often it is done.

        ``stage`` names the work for who follows it. Raises what ``function`` raises.
        """
        ...


class OneProcess:
    """Does one job after the other, here."""

    at_once = 1

    def map(self, stage: str, function: Callable[[J], R], jobs: Sequence[J]) -> list[R]:
        """As in the protocol."""
        return [function(job) for job in jobs]
