"""``geogs bench NAME [DATA]``: a benchmark in one command, with its tables as files."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from geogs.cli.options import parse_options
from geogs_bench.settings import BenchSettings

if TYPE_CHECKING:
    from rich.table import Table

    from geogs_bench.bench import Benched


@dataclass(frozen=True)
class BenchOptions(BenchSettings):
    """Run a benchmark on your copy of its data, score it, write the tables.

    ``geogs bench list`` says which there are, what data each needs and where to get it. What was
    finished before in the same folder is not run again.
    """


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code: 0 if every scene was scored, else 2."""
    options = parse_options(BenchOptions, argv, "bench")

    from rich.console import Console

    from geogs_bench.bench import bench, listing

    if options.name == "list":
        print(listing())
        return 0
    done = bench(options, lambda text: print(text, file=sys.stderr, flush=True))
    for table in _tables(done):
        Console().print(table)
    print(f"Results are in {done.output}/ (results.md, results.json, report/index.html)")
    return 2 if not done.records or any(record.error for record in done.records) else 0


def _tables(done: "Benched") -> "list[Table]":
    """The tables of a benchmark for a terminal."""
    from rich.table import Table

    from geogs_bench.tables import result_tables

    shown = []
    for table in result_tables(done.benchmark, done.records):
        shown.append(Table(*table.header, title=table.title, caption=table.note or None))
        for column in shown[-1].columns[1:]:
            column.justify = "right"
        for row in table.rows:
            shown[-1].add_row(*row)
    return shown
