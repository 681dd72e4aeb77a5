"""The board as a table."""

from collections.abc import Sequence

import numpy as np

from geogs_bench.board.board_record import BoardRecord, RowRecord
from geogs_bench.board.comparison import FIGURES, Difference, Figure


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
