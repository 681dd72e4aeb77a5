"""What the scores of every protocol have in common."""

from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class SurfaceScores(Protocol):
    """Errors of a surface by one protocol."""

    @property
    def protocol(self) -> str:
        """Its name."""
        ...

    @property
    def colour_limit_cm(self) -> float:
        """Distance that pictures show as the worst."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        ...

    def rows(self) -> list[tuple[str, str]]:
        """Name with unit, and value, of what a table shows."""
        ...
