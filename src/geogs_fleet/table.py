"""``fleet.json`` and the page of a fleet: a row for every source, failures first."""

import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args
from urllib.parse import quote

from geogs.evaluation.duration import duration
from geogs.evaluation.pages.page import FiguresSection, HtmlSection, Section, write_page
from geogs.guard.documents import UNUSABLE
from geogs_fleet.storage import StoragePath

State = Literal["done", "failed", "crashed"]
"""A crashed source is tried again: the machine or the process ended, not the work."""
FILE = "source.json"
"""File of a row in the folder of its source; written once the source is done."""


@dataclass(frozen=True)
class Row:
    """A source and its outcome."""

    name: str
    source: str
    """Its address."""
    state: State
    sentence: str
    """The verdict, or the reason of the failure."""
    settings: str
    """Digest of its settings."""
    is_reliable: bool | None = None
    """The verdict; none if nothing was judged."""
    seconds: float = 0.0
    """Duration of the last attempt."""
    attempts: int = 1
    node: str = ""
    """Name of the machine of that attempt."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Frames, keyframes, disks, mesh_faces, lost (fraction of the frames), peak_memory_bytes."""

    @property
    def trouble(self) -> tuple[int, float]:
        """Key of the table's order, highest first: failed, not reliable, much of it lost."""
        rank = 3 if self.state != "done" else {False: 2, None: 1, True: 0}[self.is_reliable]
        return rank, self.numbers.get("lost", 0.0)


def row_text(row: Row) -> str:
    """A row as JSON."""
    return json.dumps(asdict(row), indent=2)


def read_row(text: str | None) -> Row | None:
    """Parse the text of ``row_text``; none if there is none, or it is damaged."""
    try:
        given = json.loads(text or "")
        row = Row(**{f.name: given[f.name] for f in fields(Row)})
        return row if _is_sound(row) else None
    except UNUSABLE:
        return None


def _is_sound(row: Row) -> bool:
    """Whether all values of a row that was read are of the right types."""
    words = (row.name, row.source, row.sentence, row.settings, row.node)
    numbers = (row.seconds, row.attempts, *row.numbers.values())
    return (
        all(isinstance(word, str) for word in words)
        and row.name.isprintable()
        and all(isinstance(n, int | float) and math.isfinite(n) for n in numbers)
        and row.state in get_args(State)
        and row.is_reliable in (True, False, None)
    )


def numbers_of(summary: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of a ``summary.json`` for the table; missing ones are left out."""
    names = ("frames", "keyframes", "disks", "mesh_faces", "peak_memory_bytes")
    found = {name: summary.get(name) for name in names}
    verdict = summary.get("verdict")
    found["lost"] = verdict.get("lost") if isinstance(verdict, Mapping) else None
    return {name: float(v) for name, v in found.items() if isinstance(v, int | float)}


_HEAD = ("", "source", "verdict", "frames", "lost", "keyframes", "triangles", "time", "attempts")
_STYLE = """<style>
.fleet td { vertical-align: middle; } .fleet img { display: block; max-width: 120px;
  max-height: 75px; border-radius: 4px; } .fleet td.said { white-space: normal; text-align: left;
  min-width: 24em; max-width: 44em; } .fleet td:nth-child(2) { text-align: left; }
.fleet .bad { color: var(--bad); } .fleet .good { color: var(--good); }
</style>"""


def write_table(output: StoragePath, rows: Sequence[Row], waiting: int, seconds: float) -> None:
    """Write ``fleet.json`` and ``index.html`` into the folder of the results.

    Args:
        output: the folder.
        rows: of the sources that have ended, now or before.
        waiting: number of sources that have not.
        seconds: duration of this call so far.

    Raises:
        OutputError: they cannot be written.
    """
    ordered = sorted(rows, key=lambda row: (*(-t for t in row.trouble), row.name))
    document = {
        "done": sum(row.state == "done" for row in rows),
        "failed": sum(row.state != "done" for row in rows),
        "waiting": waiting,
        "seconds": round(seconds, 3),
        "sources": [asdict(row) for row in ordered],
    }
    (output / "fleet.json").write(json.dumps(document, indent=2))
    with TemporaryDirectory() as folder:
        page = Path(folder) / "index.html"
        sections: list[Section] = [
            _figures(rows, waiting, seconds),
            HtmlSection(table_html(ordered)),
        ]
        write_page(page, output.name or "fleet", sections, "geogs fleet")
        (output / "index.html").write(page.read_text("utf-8"))


def table_html(rows: Sequence[Row]) -> str:
    """The rows as an HTML table in their order; all text is escaped."""
    head = "".join(f"<th>{title}</th>" for title in _HEAD)
    body = "\n".join(map(_row_html, rows))
    table = f"<table class=fleet><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"
    return f"{_STYLE}<div class=wide>{table}</div>"


def _row_html(row: Row) -> str:
    name = html.escape(row.name)
    folder = quote(row.name)
    picture = ""
    if row.state == "done":
        picture = f'<img loading=lazy src="{folder}/thumbnail.webp" alt="">'
        name = f'<a href="{folder}/report/index.html">{name}</a>'
    mark = {3: "bad", 2: "bad", 1: "", 0: "good"}[row.trouble[0]]
    said = f'<td class="said {mark}">{html.escape(row.sentence)}</td>'
    lost = f"{row.numbers['lost']:.0%}" if "lost" in row.numbers else ""
    cells = [
        _count(row, "frames"),
        lost,
        _count(row, "keyframes"),
        _count(row, "mesh_faces"),
        duration(row.seconds),
        str(row.attempts),
    ]
    plain = "".join(f"<td>{cell}</td>" for cell in cells)
    title = html.escape(row.source, quote=True)
    return f'<tr><td>{picture}</td><td title="{title}">{name}</td>{said}{plain}</tr>'


def _figures(rows: Sequence[Row], waiting: int, seconds: float) -> FiguresSection:
    done = [row for row in rows if row.state == "done"]
    frames = sum(row.numbers.get("frames", 0) for row in done)
    figures = [
        ("done", str(len(done))),
        ("failed", str(len(rows) - len(done))),
        ("not reliable", str(sum(row.is_reliable is False for row in done))),
        ("waiting", str(waiting)),
        ("frames", f"{frames:,.0f}".replace(",", " ")),
        ("time", duration(seconds)),
    ]
    return FiguresSection("", None, figures)


def _count(row: Row, name: str) -> str:
    return f"{row.numbers[name]:,.0f}".replace(",", " ") if name in row.numbers else ""
