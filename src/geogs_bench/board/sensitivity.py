"""Sensitivity of the board to the constants of modules: each halved and doubled.

A constant that changes no figure by more than its noise is flat: it may have a round value, the
value of its neighbours, or go with its branch.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

from geogs.errors import InputError
from geogs.guard.atomic import write_text
from geogs_bench.bench_options import BenchOptions
from geogs_bench.board.board import Board, opened_board
from geogs_bench.board.comparison import Difference, compare
from geogs_bench.board.with_constant import Constant

FACTORS = (0.5, 2.0)
"""Factors by which a constant is changed."""


@dataclass(frozen=True)
class Sensitivity:
    """Changes of the board by one constant."""

    constant: Constant
    value: float
    changes: tuple[tuple[Difference, ...], ...]
    """Figures that changed by more than their noise, for each of ``FACTORS``."""

    @property
    def is_flat(self) -> bool:
        """Whether no figure changes."""
        return not any(self.changes)


def sensitivity(options: BenchOptions, say: Callable[[str], None]) -> list[Sensitivity]:
    """Run the chosen rows unchanged and with each constant halved and doubled.

    Raises:
        InputError: an option is wrong, or a module has no such number.
        OutputError: the folder cannot be written.
    """
    if not options.constants:
        raise InputError("give the constants, such as --constants geogs.depth.edges:CONTRAST.")
    values = {constant: _value(constant) for constant in map(_named, options.constants)}
    usual = opened_board(options, say)
    record = usual.run()
    found = []
    for constant, value in values.items():
        changes = tuple(
            tuple(compare(record, _changed(usual, constant, _scaled(value, factor)).run()))
            for factor in FACTORS
        )
        found.append(Sensitivity(constant, value, changes))
        write_text(usual.output / "sensitivity.md", table(found))
    return found


def table(found: list[Sensitivity]) -> str:
    """The constants as a table in Markdown."""
    rows = ["| constant | value | halved | doubled |", "|---|---|---|---|"]
    for one in found:
        cells = ["; ".join(map(str, changes)) or "flat" for changes in one.changes]
        rows.append(f"| `{one.constant}` | {one.value:g} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def _changed(usual: Board, constant: Constant, value: float) -> Board:
    """The same board with another value of a constant, in a folder of its own."""
    output = usual.output / f"{constant.module}.{constant.name}-{value:g}"
    return replace(usual, output=output, changed=(constant, value))


def _scaled(value: float, factor: float) -> float:
    """The value times a factor; a whole number stays one and changes by 1 at least."""
    if isinstance(value, int):
        return round(value * factor) if value > 1 else value + (1 if factor > 1 else -1)
    return value * factor


def _named(words: str) -> Constant:
    try:
        return Constant.named(words)
    except ValueError:
        raise InputError(f"{words} is no constant; write it as MODULE:NAME.") from None


def _value(constant: Constant) -> float:
    try:
        value = getattr(importlib.import_module(constant.module), constant.name)
    except (ImportError, AttributeError):
        raise InputError(f"{constant} does not exist.") from None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{constant} is no single number.")
    return value
