"""Report pages: one HTML file of figures, tables, pictures and text; no server."""

import base64
import hashlib
import html
import os
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from urllib.parse import quote

from geogs.guard.atomic import write_text


@dataclass(frozen=True)
class TableSection:
    """A table under a heading; the first column names a row, the others are right-aligned."""

    heading: str
    columns: Sequence[str]
    """Column titles; without any there is no head."""
    rows: Sequence[Sequence[str]]
    """Cells as text; a name that begins with spaces is indented."""
    note: str = ""
    """A sentence under the table."""


@dataclass(frozen=True)
class PictureSection:
    """A picture under a heading; left out where it is missing or cannot be copied."""

    heading: str
    file: Path


@dataclass(frozen=True)
class TextSection:
    """Preformatted text under a heading."""

    heading: str
    text: str


@dataclass(frozen=True)
class FiguresSection:
    """A verdict, and the main numbers side by side."""

    sentence: str
    """Empty without a verdict."""
    is_good: bool | None
    """Mark of the verdict; none is neutral."""
    figures: Sequence[tuple[str, str]]
    """Name with unit, and value, of each number."""


@dataclass(frozen=True)
class HtmlSection:
    """A part in HTML, such as the interactive model."""

    html: str
    scripts: Sequence[str] = ()
    """Scripts in it that may run, without their tags."""


Section = TableSection | PictureSection | TextSection | FiguresSection | HtmlSection


def write_page(
    path: Path, title: str, sections: Sequence[Section], subtitle: str = "", is_whole: bool = False
) -> None:
    """Write a page for any browser, from the disk: also on a phone, and in dark mode.

    All text is escaped. Pictures are linked by their path relative to the page and are not copied,
    so they should lie beside it; with ``is_whole`` the page embeds copies of them, as WebP, and
    needs no other file.

    Args:
        path: the page, usually ``index.html`` of a folder.
        title: title of the page.
        sections: tables, pictures and texts in the order in which they appear.
        subtitle: a line under the title.
        is_whole: whether pictures are embedded.

    Raises:
        OutputError: it cannot be written.
    """
    body = [f"<h1>{html.escape(title)}</h1>"]
    if subtitle:
        body.append(f"<p class=note>{html.escape(subtitle)}</p>")
    folder = None if is_whole else path.parent
    body += [part for section in sections if (part := _section(section, folder))]
    text = "\n".join(body)
    scripts = [
        s for section in sections if isinstance(section, HtmlSection) for s in section.scripts
    ]
    policy = _policy(scripts) if is_whole else ""
    write_text(path, f"{_head(title, policy)}<body>\n{text}\n</body></html>\n")


def _policy(scripts: Sequence[str]) -> str:
    """Content security policy: nothing is loaded, and only these scripts run."""
    digests = [hashlib.sha256(script.encode("utf-8")).digest() for script in scripts]
    allowed = [f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests]
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; "
        f"script-src {' '.join(allowed) or repr('none')}; base-uri 'none'; form-action 'none'"
    )
    return f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'


def _head(title: str, policy: str) -> str:
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n{policy}'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>"
    )


def _section(section: Section, folder: Path | None) -> str:
    match section:
        case TableSection():
            return _table(section)
        case PictureSection():
            return _picture(section, folder)
        case FiguresSection():
            return _figures(section)
        case HtmlSection():
            return section.html
        case TextSection():
            return f"{_heading(section.heading)}<pre>{html.escape(section.text)}</pre>"


def _table(section: TableSection) -> str:
    head = ""
    if section.columns:
        cells = "".join(f"<th>{html.escape(title)}</th>" for title in section.columns)
        head = f"<thead><tr>{cells}</tr></thead>"
    rows = "\n".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in section.rows)
    note = f"<p class=note>{html.escape(section.note)}</p>" if section.note else ""
    table = f"<div class=wide><table>{head}<tbody>\n{rows}\n</tbody></table></div>"
    return _heading(section.heading) + table + note


def _cell(text: str) -> str:
    """A cell of a table; a sentence wraps, so that it pushes no other cell out of sight."""
    mark = " class=long" if len(text) > 40 else ""
    return f"<td{mark}>{html.escape(text)}</td>"


def _figures(section: FiguresSection) -> str:
    mark = {True: "good", False: "bad", None: ""}[section.is_good]
    sentence = f'<p class="verdict {mark}">{html.escape(section.sentence)}</p>'
    cells = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in section.figures
    )
    return (sentence if section.sentence else "") + f"<dl>{cells}</dl>"


def _picture(section: PictureSection, folder: Path | None) -> str:
    if not section.file.is_file():
        return ""
    if folder is None:
        place = _inside(section.file)
    else:
        place = quote(Path(os.path.relpath(section.file, folder)).as_posix())
    if not place:
        return ""
    image = f'<img src="{place}" alt="{html.escape(section.heading)}">'
    linked = image if folder is None else f'<a href="{place}">{image}</a>'
    return f"{_heading(section.heading)}<figure>{linked}</figure>"


def _inside(file: Path) -> str:
    """A picture as a data URL; empty if it is no picture, or far too large."""
    import cv2
    from PIL import Image

    from geogs.io.pictures import decoded

    rgb = decoded(file, cv2.IMREAD_COLOR).rgb
    if rgb is None:
        return ""
    stream = BytesIO()
    Image.fromarray(rgb).save(stream, "WEBP", quality=88, method=2)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _heading(text: str) -> str:
    return f"<h2>{html.escape(text)}</h2>\n" if text else ""


_STYLE = """
:root { --text: #1d2127; --soft: #646c78; --line: #e3e6ea; --back: #fff; --box: #f5f6f8;
  --good: #1f8a55; --bad: #b8561b; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e4e7ec; --soft: #949ca8; --line: #2c3138; --back: #121417; --box: #1b1e23;
    --good: #5cc690; --bad: #eb9a5c; }
}
body { font: 15px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
  max-width: 1180px; margin: 0 auto; padding: 1.6em 1.2em 4em; }
h1 { font-size: 2.1em; font-weight: 650; letter-spacing: -0.02em; line-height: 1.2; margin: 0; }
h2 { font-size: 1.08em; font-weight: 600; margin: 2.2em 0 0.6em; }
.verdict { font-size: 1.15em; margin: 0.5em 0 0.7em; padding-left: 1.15em; position: relative;
  max-width: 80ch; }
.verdict::before { content: ""; position: absolute; left: 0; top: 0.5em; width: 0.55em;
  height: 0.55em; border-radius: 50%; background: var(--soft); }
.verdict.good::before { background: var(--good); } .verdict.bad::before { background: var(--bad); }
dl { display: flex; flex-wrap: wrap; gap: 0.6em 2.2em; margin: 0.8em 0; }
dt { color: var(--soft); font-size: 0.9em; } dd { margin: 0; font-size: 1.5em; line-height: 1.25;
  font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; } table { border-collapse: collapse; }
th, td { padding: 0.22em 1.2em 0.22em 0; border-bottom: 1px solid var(--line); white-space: pre;
  text-align: right; font-variant-numeric: tabular-nums; }
td.long { white-space: pre-wrap; overflow-wrap: anywhere; text-align: left; max-width: 60ch; }
th { font-weight: 600; } th:first-child, td:first-child { text-align: left; }
tbody tr:hover { background: var(--box); }
figure { margin: 0; } figure img { max-width: 100%; height: auto; border-radius: 6px;
  background: #fff; }
.note { color: var(--soft); font-size: 0.92em; margin: 0.4em 0; }
pre { background: var(--box); color: var(--soft); padding: 0.8em 1em; border-radius: 6px;
  overflow-x: auto; font-size: 0.87em; }
"""
