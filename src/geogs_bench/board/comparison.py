"""Comparison of a board with an earlier one: the figures that changed by more than their noise."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from geogs_bench.board.board_record import BoardRecord, RowRecord

_T = 4.6
"""Student's t for four degrees of freedom (three seeds before, three now); one of a hundred
comparisons of equal figures exceeds it."""


@dataclass(frozen=True)
class Figure:
    """A column of the board."""

    name: str
    """Name of the attribute of an outcome."""
    title: str
    digits: int
    better: Literal["more", "less", "neither"]
    least: float = 0.0
    """Differences below this do not count, however small the noise."""
    least_ratio: float = 0.0
    """The same as a fraction of the value before."""


FIGURES = (
    Figure("placed", "placed %", 0, "more", least=1.0),
    Figure("ate", "ATE cm", 3, "less", least=0.001, least_ratio=0.05),
    Figure("error_per_sigma", "error/σ", 2, "neither"),
    Figure("reliable", "reliable", 2, "neither"),
    Figure("misjudged", "misjudged", 2, "less", least=0.3),
    Figure("accuracy", "Acc cm", 3, "less", least_ratio=0.02),
    Figure("completeness", "Comp.Rat %", 1, "more", least=0.2),
    Figure("f_score", "F %", 1, "more", least=0.2),
    Figure("online_accuracy", "online Acc", 3, "less", least_ratio=0.02),
    Figure("online_completeness", "online Comp.Rat", 1, "more", least=0.2),
    Figure("online_f_score", "online F", 1, "more", least=0.2),
    Figure("cost", "cost", 1, "less", least_ratio=0.15),
    Figure("seconds", "s", 1, "less", least_ratio=0.1),
    Figure("memory", "MB", 0, "less", least_ratio=0.05),
    Figure("disks", "disks", 0, "neither"),
    Figure("triangles", "triangles", 0, "neither"),
)


@dataclass(frozen=True)
class Difference:
    """A figure of a row that has changed by more than its noise."""

    row: str
    figure: Figure
    before: float
    now: float
    noise: float
    """Threshold that the difference exceeded."""
    is_worse: bool

    def __str__(self) -> str:
        digits = self.figure.digits
        word = "worse" if self.is_worse else "better"
        return (
            f"{word}: {self.row}, {self.figure.title}: {self.before:.{digits}f} -> "
            f"{self.now:.{digits}f} (noise {self.noise:.{max(digits, 1)}f})"
        )


def compare(before: BoardRecord, now: BoardRecord) -> list[Difference]:
    """Find the figures that changed by more than their noise, the worse ones first."""
    found: list[Difference] = []
    is_same_machine = before.machine == now.machine and before.device == now.device
    for row in now.rows:
        earlier = before.row(row.name)
        if earlier and (earlier.command, earlier.footage) == (row.command, row.footage):
            # Wall-clock times cannot be compared where a command waits for concurrent ones.
            found += _differences(earlier, row, is_same_machine and row.runs_alone)
    return sorted(found, key=lambda difference: not difference.is_worse)


def _differences(before: RowRecord, now: RowRecord, same_clock: bool) -> Iterator[Difference]:
    failed_before = float(len(before.failures))
    failed_now = float(len(now.failures))
    if failed_now > failed_before:
        failures = Figure("failures", "commands that failed", 0, "less")
        yield Difference(now.name, failures, failed_before, failed_now, 0.0, is_worse=True)
    for figure in FIGURES:
        if figure.better == "neither" or (figure.name == "seconds" and not same_clock):
            continue
        difference = _difference(
            now.name, figure, before.values(figure.name), now.values(figure.name)
        )
        if difference is not None:
            yield difference


def _difference(
    row: str, figure: Figure, before: Sequence[float], now: Sequence[float]
) -> Difference | None:
    """Difference by Student's t test, if it also exceeds the figure's least difference."""
    if not before or not now:
        return None
    was = float(np.mean(before))
    is_now = float(np.mean(now))
    spread = math.sqrt((_squares(before) + _squares(now)) / max(len(before) + len(now) - 2, 1))
    noise = _T * spread * math.sqrt(1 / len(before) + 1 / len(now))
    noise = max(noise, figure.least, figure.least_ratio * abs(was))
    if abs(is_now - was) <= noise:
        return None
    is_more = is_now > was
    return Difference(row, figure, was, is_now, noise, is_more != (figure.better == "more"))


def _squares(values: Sequence[float]) -> float:
    """Sum of squared differences from the mean."""
    return float(np.square(np.asarray(values) - np.mean(values)).sum())


def markdown(board: BoardRecord, changes: Sequence[Difference]) -> str:
    """The board as Markdown, with the failures and the changes."""
    failures = [f"- {row.name}: {why}" for row in board.rows for why in dict.fromkeys(row.failures)]
    lines = [
        "# The board",
        "",
        f"geogs {board.commit}; {board.machine}; {board.device}; {board.side_by_side} commands "
        "at a time. Means over three seeds ± their standard deviation; cost: seconds of the "
        "processor over those of a fixed computation.",
        "",
        f"| {' | '.join(['row', *(figure.title for figure in FIGURES)])} |",
        f"|---|{'---:|' * len(FIGURES)}",
        *(_line(row) for row in board.rows),
        "",
        *failures,
        *(f"- {change}" for change in changes),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _line(row: RowRecord) -> str:
    return f"| {' | '.join([row.name, *(_cell(row, figure) for figure in FIGURES)])} |"


def _cell(row: RowRecord, figure: Figure) -> str:
    values = row.values(figure.name)
    if not values:
        return "-"
    text = f"{np.mean(values):.{figure.digits}f}"
    spread = np.std(values, ddof=1) if len(values) > 1 else 0.0
    if spread < 0.5 * 10**-figure.digits:
        return text
    return f"{text} ± {spread:.{figure.digits}f}"
