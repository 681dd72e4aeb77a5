"""What a forecast asks of the work whose end it tells."""

from collections.abc import Collection
from typing import Protocol, runtime_checkable


@runtime_checkable
class Plan(Protocol):
    """The stages of a command, and how long they take on a machine of reference."""

    @property
    def frames(self) -> int:
        """Frames that are tracked; none in other work."""
        ...

    @property
    def end(self) -> float | None:
        """When it is to be done, by the performance counter, where a time is given."""
        ...

    @property
    def fixed(self) -> Collection[str]:
        """Stages that take their time whatever is given."""
        ...

    def tracked(self, frames: int, keyframes: float | int) -> float:
        """Seconds of so many frames, with what is mapped on the way."""
        ...

    def seconds(self, keyframes: float | int) -> dict[str, float]:
        """Of each stage in its order, with so many keyframes."""
        ...

    def at(self, reported: str, fraction: float) -> tuple[str, float]:
        """Stage and its finished part, where ``fraction`` of something is reported as done; another
        name where that is not planned."""
        ...
