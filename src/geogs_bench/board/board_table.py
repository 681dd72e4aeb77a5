"""The board as a table."""

from collections.abc import Sequence

import numpy as np

from geogs_bench.board.board_record import BoardRecord, RowRecord
from geogs_bench.board.comparison import FIGURES, Difference, Figure


def header() -> list[str]:
    """Titles of the columns that some row may have."""
    return ["row", *(figure.title for figure in FIGURES)]


def cells(row: RowRecord) -> list[str]:
    """A row: mean and standard deviation over the seeds; at its end why commands failed."""
    return [row.name, *(_cell(row, figure) for figure in FIGURES)]


def markdown(board: BoardRecord, changes: Sequence[Difference]) -> str:
    """The board as Markdown, with what has changed."""
    failures = [f"- {row.name}: {why}" for row in board.rows for why in dict.fromkeys(row.failures)]
    lines = [
        "# The board",
        "",
        f"geogs {board.commit}; {board.machine}; {board.device}; {board.side_by_side} commands "
        f"at a time; {board.minutes:.0f} minutes. Means over three seeds ± their standard "
        "deviation; cost: seconds of the processor over those of a fixed computation.",
        "",
        f"| {' | '.join(header())} |",
        f"|---|{'---:|' * len(FIGURES)}",
        *(f"| {' | '.join(cells(row))} |" for row in board.rows),
        "",
        *failures,
        *(f"- {change}" for change in changes),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _cell(row: RowRecord, figure: Figure) -> str:
    values = row.values(figure.name)
    if not values:
        return "-"
    text = f"{np.mean(values):.{figure.digits}f}"
    spread = np.std(values, ddof=1) if len(values) > 1 else 0.0
    if spread < 0.5 * 10**-figure.digits:
        return text
    return f"{text} ± {spread:.{figure.digits}f}"
