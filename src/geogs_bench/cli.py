"""``geogs bench NAME [DATA]``: a benchmark in one command, with its tables as files."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from geogs.cli.options import parse_options
from geogs.guard.terminal_text import printable, say
from geogs_bench.bench_options import BenchOptions

if TYPE_CHECKING:
    from rich.table import Table

    from geogs_bench.bench import BenchResult


def main(argv: Sequence[str]) -> int:
    """Run the command; return the exit code: 0 if every scene was scored, else 2."""
    options = parse_options(BenchOptions, argv, "bench")

    from rich.console import Console

    from geogs_bench.bench import bench, listing

    if options.name == "list":
        say(*listing().splitlines())
        return 0
    if options.name == "board":
        return _board(options)
    if options.name == "sensitivity":
        return _sensitivity(options)
    done = bench(options, partial(say, is_error=True))
    for table in _tables(done):
        Console(markup=False).print(table)
    say(f"Results are in {done.output}/ (results.md, results.json, report/index.html)")
    records = [record for chapter in done.chapters for record in chapter.records]
    return 2 if not records or any(record.error for record in records) else 0


def _board(options: BenchOptions) -> int:
    """Run the board; return 2 if a command failed, 1 if a figure got worse, else 0."""
    from geogs_bench.board.board import board
    from geogs_bench.board.comparison import markdown

    done, changes = board(options, partial(say, is_error=True))
    say(*markdown(done, changes).splitlines())
    if any(row.failures for row in done.rows):
        return 2
    return 1 if any(change.is_worse for change in changes) else 0


def _sensitivity(options: BenchOptions) -> int:
    """Halve and double constants on the board."""
    from geogs_bench.board.sensitivity import sensitivity, table

    say(*table(sensitivity(options, partial(say, is_error=True))).splitlines())
    return 0


def _tables(done: "BenchResult") -> "list[Table]":
    """The tables of all chapters for a terminal."""
    from rich.table import Table

    from geogs_bench.tables.benchmark_report import chapter_tables

    shown = []
    for table in (table for chapter in done.chapters for table in chapter_tables(chapter)):
        shown.append(Table(*table.header, title=table.title, caption=table.note or None))
        for column in shown[-1].columns[1:]:
            column.justify = "right"
        for row in table.rows:
            shown[-1].add_row(*map(printable, row))
    return shown
