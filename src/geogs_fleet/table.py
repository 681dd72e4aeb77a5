"""``fleet.json`` and the page of a fleet: a row for every source, failures first."""

import html
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from geogs.evaluation.duration import duration
from geogs.evaluation.pages.page import FiguresSection, HtmlSection, Section, write_page
from geogs_fleet.row import Row
from geogs_fleet.storage import StoragePath

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
    name, folder = html.escape(row.name), quote(row.name)
    picture = ""
    if row.state == "done":
        picture = f'<img loading=lazy src="{folder}/thumbnail.webp" alt="">'
        name = f'<a href="{folder}/report/index.html">{name}</a>'
    mark = {3: "bad", 2: "bad", 1: "", 0: "good"}[row.trouble[0]]
    said = f'<td class="said {mark}">{html.escape(row.sentence)}</td>'
    lost = f"{row.numbers['lost']:.0%}" if "lost" in row.numbers else ""
    cells = [
        _count(row, "frames"), lost, _count(row, "keyframes"), _count(row, "mesh_faces"),
        duration(row.seconds), str(row.attempts),
    ]  # fmt: skip
    plain = "".join(f"<td>{cell}</td>" for cell in cells)
    title = html.escape(row.source, quote=True)
    return f'<tr><td>{picture}</td><td title="{title}">{name}</td>{said}{plain}</tr>'


def _figures(rows: Sequence[Row], waiting: int, seconds: float) -> FiguresSection:
    done = [row for row in rows if row.state == "done"]
    doubtful = sum(row.is_reliable is False for row in done)
    shown = [
        ("done", len(done)), ("failed", len(rows) - len(done)), ("not reliable", doubtful),
        ("waiting", waiting),
    ]  # fmt: skip
    frames = sum(row.numbers.get("frames", 0) for row in done)
    figures = [(name, str(number)) for name, number in shown]
    figures += [("frames", f"{frames:,.0f}".replace(",", " ")), ("time", duration(seconds))]
    return FiguresSection("", None, figures)


def _count(row: Row, name: str) -> str:
    return f"{row.numbers[name]:,.0f}".replace(",", " ") if name in row.numbers else ""
