"""What a fleet reads: lists of sources, and rows of those that are done."""

from pathlib import Path

import mutations
from geogs_fleet.sources import find_sources
from geogs_fleet.storage import StoragePath
from geogs_fleet.table import FILE, Row, read_row, row_text, table_html
from parsers.base import Parser, written


def fleets() -> dict[str, Parser]:
    """What ``geogs fleet`` reads."""
    row = Row("a", "/videos/a.mp4", "done", "Good.", "0123", True, 7.5, 1, "node", {"lost": 0.1})
    names = "# videos\na.mp4\n/b/c.mp4\n~/d.mp4\nb/*.mp4\n"
    return {
        "fleet-row": Parser(written(FILE, row_text(row)), (FILE,), mutations.json_text, table),
        "fleet-list": Parser(
            written("list.txt", names), ("list.txt",), mutations.text,
            lambda folder: find_sources([str(folder / "list.txt")]),
        ),
    }  # fmt: skip


def table(folder: Path) -> object:
    """The row beside others, as they are shown."""
    row = read_row(StoragePath(str(folder / FILE)).read())
    rows = [row] if row is not None else []
    return table_html(sorted(rows, key=lambda row: row.trouble))
