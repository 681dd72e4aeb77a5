"""Measurements of the board, and their file."""

from dataclasses import dataclass
from pathlib import Path

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, read_json
from geogs_bench.results.record import read_dataclass, write_json


@dataclass(frozen=True)
class Outcome:
    """Scores of a command with one seed. A figure is none if the result does not allow it."""

    error: str | None = None
    """Message with which the command failed."""
    placed: float | None = None
    """Frames with a pose, percent."""
    ate: float | None = None
    """RMSE of the positions after Sim(3) alignment, cm."""
    error_per_sigma: float | None = None
    """Errors of positions over their predicted standard deviations, both RMS."""
    reliable: float | None = None
    """1 if the verdict is that the result is reliable, else 0."""
    misjudged: float | None = None
    """1 if the verdict is so although the ATE is a twentieth of the path's extent or more."""
    accuracy: float | None = None
    """Mean distance of the surface to the true one, cm."""
    completeness: float | None = None
    """Fraction of the true surface nearer than 5 cm, percent."""
    f_score: float | None = None
    online_accuracy: float | None = None
    """The same for the surface at the end of the stream, before the final adjustment."""
    online_completeness: float | None = None
    online_f_score: float | None = None
    cost: float | None = None
    """Processor time of all threads over that of the fixed computation."""
    seconds: float | None = None
    """Wall-clock time of the whole command."""
    memory: float | None = None
    """Peak memory of a process, MB."""
    disks: int | None = None
    triangles: int | None = None


@dataclass(frozen=True)
class RowRecord:
    """Results of a row."""

    name: str
    footage: str
    """Description of the sequence."""
    command: str
    runs_alone: bool
    outcomes: tuple[Outcome, ...]
    """One for each seed."""

    def values(self, figure: str) -> list[float]:
        """Values of a figure for the seeds that have it."""
        found = (getattr(outcome, figure) for outcome in self.outcomes)
        return [float(value) for value in found if value is not None]

    @property
    def failures(self) -> list[str]:
        """Messages of the commands that failed."""
        return [outcome.error for outcome in self.outcomes if outcome.error is not None]


@dataclass(frozen=True)
class BoardRecord:
    """All rows, with the machine and the program."""

    commit: str
    machine: str
    device: str
    reference_seconds: float
    """Processor time of the fixed computation."""
    side_by_side: int
    """Number of concurrent commands, except for the rows that run alone."""
    rows: tuple[RowRecord, ...]

    def row(self, name: str) -> RowRecord | None:
        """The row of a name."""
        return next((row for row in self.rows if row.name == name), None)


def read_board(path: Path) -> BoardRecord:
    """Read a record of :func:`write_board`. Raises InputError if that fails."""
    try:
        return read_dataclass(BoardRecord, read_json(path))
    except UNUSABLE as error:
        raise InputError(f"{path} is no record of the board.") from error


def write_board(path: Path, board: BoardRecord) -> None:
    """Write a record. Raises OutputError if that fails."""
    write_json(path, board)
