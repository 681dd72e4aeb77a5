"""Report pages: one static HTML file of tables, pictures and text; no server, no scripts."""

import html
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from geogs.io.writers.atomic import write_text


@dataclass(frozen=True)
class TableSection:
    """A table under a heading; the first column names a row, the others are set to the right."""

    heading: str
    columns: Sequence[str]
    """Their titles; none shows no head."""
    rows: Sequence[Sequence[str]]
    """Cells as text; a name that begins with spaces is set in."""
    note: str = ""
    """A sentence under the table."""


@dataclass(frozen=True)
class PictureSection:
    """A picture under a heading, linked relative to the page; left out where it is missing."""

    heading: str
    file: Path
    caption: str = ""


@dataclass(frozen=True)
class TextSection:
    """Text under a heading, with its spaces and line ends kept where it is preformatted."""

    heading: str
    text: str
    preformatted: bool = True


Section = TableSection | PictureSection | TextSection


def write_page(path: Path, title: str, sections: Sequence[Section], subtitle: str = "") -> None:
    """Write a page that any browser shows from the disk: on a phone, and in the dark, too.

    All text is escaped. Pictures are linked by their place relative to the page and are not
    copied, so they should lie beside it.

    Args:
        path: the page, usually ``index.html`` of a folder.
        title: of the page.
        sections: tables, pictures and texts in the order in which they appear.
        subtitle: a line under the title.

    Raises:
        OutputError: it cannot be written.
    """
    body = [f"<h1>{html.escape(title)}</h1>"]
    if subtitle:
        body.append(f"<p class=note>{html.escape(subtitle)}</p>")
    body += [part for section in sections if (part := _section(section, path.parent))]
    text = "\n".join(body)
    write_text(path, f"{_head(title)}<body>\n{text}\n</body></html>\n")


def _head(title: str) -> str:
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>"
    )


def _section(section: Section, folder: Path) -> str:
    match section:
        case TableSection():
            return _table(section)
        case PictureSection():
            return _picture(section, folder)
        case TextSection():
            tag = "pre" if section.preformatted else "p"
            return f"{_heading(section.heading)}<{tag}>{html.escape(section.text)}</{tag}>"


def _table(section: TableSection) -> str:
    head = ""
    if section.columns:
        cells = "".join(f"<th>{html.escape(title)}</th>" for title in section.columns)
        head = f"<thead><tr>{cells}</tr></thead>"
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for row in section.rows
    )
    note = f"<p class=note>{html.escape(section.note)}</p>" if section.note else ""
    table = f"<div class=wide><table>{head}<tbody>\n{rows}\n</tbody></table></div>"
    return _heading(section.heading) + table + note


def _picture(section: PictureSection, folder: Path) -> str:
    if not section.file.is_file():
        return ""
    place = quote(Path(os.path.relpath(section.file, folder)).as_posix())
    caption = section.caption or section.heading
    below = f"<figcaption>{html.escape(section.caption)}</figcaption>" if section.caption else ""
    image = f'<a href="{place}"><img src="{place}" alt="{html.escape(caption)}"></a>'
    return f"{_heading(section.heading)}<figure>{image}{below}</figure>"


def _heading(text: str) -> str:
    return f"<h2>{html.escape(text)}</h2>\n" if text else ""


_STYLE = """
:root { --text: #1c2330; --soft: #5b6675; --line: #d9dee6; --back: #fff; --box: #f4f6f9; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e3e7ee; --soft: #9aa5b5; --line: #343b47; --back: #14171c; --box: #1d2128; }
}
body { font: 15px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
  max-width: 1100px; margin: 0 auto; padding: 1.5em 1em 4em; }
h1 { font-size: 1.6em; margin: 0.3em 0; } h2 { font-size: 1.15em; margin: 1.8em 0 0.5em; }
.wide { overflow-x: auto; } table { border-collapse: collapse; }
th, td { padding: 0.2em 1em 0.2em 0; border-bottom: 1px solid var(--line); white-space: pre;
  text-align: right; font-variant-numeric: tabular-nums; }
th { font-weight: 600; } th:first-child, td:first-child { text-align: left; }
tbody tr:hover { background: var(--box); }
figure { margin: 0; } img { max-width: 100%; height: auto; border-radius: 4px; background: #fff; }
figcaption, .note { color: var(--soft); font-size: 0.92em; margin: 0.4em 0; }
pre { background: var(--box); color: var(--soft); padding: 0.8em 1em; border-radius: 4px;
  overflow-x: auto; font-size: 0.87em; }
"""
