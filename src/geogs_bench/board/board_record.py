"""What the board measured, and its file."""

from dataclasses import dataclass
from pathlib import Path

from geogs.documents import UNUSABLE, read_json
from geogs.errors import InputError
from geogs_bench.results.record import read_dataclass, write_json


@dataclass(frozen=True)
class Outcome:
    """A command by one seed. A figure is none where the result has nothing to measure it by."""

    error: str | None = None
    """The sentence with which it failed."""
    placed: float | None = None
    """Frames with a place, percent."""
    ate: float | None = None
    """RMSE of the positions after Sim(3) alignment, cm."""
    error_per_sigma: float | None = None
    """Errors of positions over their predicted deviations, both RMS."""
    reliable: float | None = None
    """1 where the verdict is that the result is reliable, else 0."""
    misjudged: float | None = None
    """1 where it says so of positions that are off by a twentieth of the path's extent or more."""
    accuracy: float | None = None
    """Mean distance of the surface to the true one, cm."""
    completeness: float | None = None
    """Part of the true surface nearer than 5 cm, percent."""
    f_score: float | None = None
    online_accuracy: float | None = None
    """The same of what the stream left, before the final adjustment."""
    online_completeness: float | None = None
    online_f_score: float | None = None
    cost: float | None = None
    """Seconds of the processor, all threads, over those of the fixed computation."""
    seconds: float | None = None
    """By the clock, from shell to shell."""
    memory: float | None = None
    """The most that a process had, MB."""
    disks: int | None = None
    triangles: int | None = None


@dataclass(frozen=True)
class RowRecord:
    """A row."""

    name: str
    footage: str
    """What the command saw, in words."""
    command: str
    runs_alone: bool
    outcomes: tuple[Outcome, ...]
    """One a seed."""

    def values(self, figure: str) -> list[float]:
        """A figure of the seeds that have it."""
        found = (getattr(outcome, figure) for outcome in self.outcomes)
        return [float(value) for value in found if value is not None]

    @property
    def failures(self) -> list[str]:
        """Why commands failed."""
        return [outcome.error for outcome in self.outcomes if outcome.error is not None]


@dataclass(frozen=True)
class BoardRecord:
    """All rows, and what they were measured on."""

    commit: str
    machine: str
    device: str
    reference_seconds: float
    """Of the processor, for the fixed computation."""
    side_by_side: int
    """Commands that ran at a time, but for the rows that run alone."""
    rows: tuple[RowRecord, ...]

    def row(self, name: str) -> RowRecord | None:
        """The row of a name."""
        return next((row for row in self.rows if row.name == name), None)


def read_board(path: Path) -> BoardRecord:
    """Read what :func:`write_board` wrote. Raises InputError where it cannot be."""
    try:
        return read_dataclass(BoardRecord, read_json(path))
    except UNUSABLE as error:
        raise InputError(f"{path} is no record of the board.") from error


def write_board(path: Path, board: BoardRecord) -> None:
    """Write a record. Raises OutputError if that fails."""
    write_json(path, board)
