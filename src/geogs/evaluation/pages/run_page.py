"""The page of a run: statistics, and the pictures that need no truth."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geogs.evaluation.duration import duration
from geogs.evaluation.model_view.model_section import model_section
from geogs.evaluation.model_view.shown_model import Lengths, ShownModel
from geogs.evaluation.pages.page import (
    FiguresSection,
    HtmlSection,
    PictureSection,
    Section,
    TableSection,
    write_page,
)
from geogs.guard.documents import UNUSABLE

PICTURES = {"keyframes.png": "Rendered keyframes", "trajectory.png": "Trajectory"}
"""Titles of the pictures that a run leaves in ``report/``, in the order of the page."""


METRES = {"metres": 1.0, "millimetres": 0.001}
"""Metres per unit of poses, by the name of the unit."""

Show = Callable[[Any], str]


def write_run_page(
    folder: Path, summary: Mapping[str, Any], model: ShownModel | None = None
) -> None:
    """Write ``index.html``, which needs no other files.

    Args:
        folder: ``report/`` of a result, with its pictures.
        summary: content of ``summary.json``; missing numbers are left out.
        model: interactive model at the top.

    Raises:
        OutputError: it cannot be written.
    """
    name = _shown(str, summary.get("source")) or "result"
    head: list[Section] = [figures(summary, run_figures(summary))]
    head += [HtmlSection(*model_section(model))] if model is not None else []
    shown = [PictureSection(title, folder / file) for file, title in PICTURES.items()]
    sections = [*head, *shown, *run_sections(summary)]
    write_page(folder / "index.html", name, sections, "geogs", is_whole=True)


def figures(summary: Mapping[str, Any], numbers: list[tuple[str, str]]) -> FiguresSection:
    """The verdict of a run above some numbers."""
    verdict = summary.get("verdict")
    if not isinstance(verdict, Mapping):
        return FiguresSection("", None, numbers)
    sentence = _shown(str, verdict.get("sentence"))
    return FiguresSection(sentence, bool(verdict.get("is_reliable")), numbers)


def run_figures(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The main numbers of a run."""
    seconds = summary.get("seconds")
    rates = summary.get("frames_per_second")
    total = seconds.get("total") if isinstance(seconds, Mapping) else None
    rate = rates.get("with_final_stages") if isinstance(rates, Mapping) else None
    shown: list[tuple[str, Show, object]] = [
        ("frames", _count, summary.get("frames")),
        ("keyframes", _count, summary.get("keyframes")),
        ("triangles", _count, summary.get("mesh_faces")),
        ("disks", _count, summary.get("disks")),
        ("time", _time, total),
        ("frames/s", "{:.2f}".format, rate),
    ]
    return [(name, text) for name, show, value in shown if (text := _shown(show, value))]


def run_sections(summary: Mapping[str, Any]) -> list[Section]:
    """Tables of ``summary.json``: the run, and the seconds of its stages."""
    rows_of_run = [
        (title, text) for title, key, show in _RUN_ROWS if (text := _shown(show, summary.get(key)))
    ]
    sections: list[Section] = [TableSection("The run", (), rows_of_run)]
    seconds = summary.get("seconds")
    if isinstance(seconds, Mapping):
        rows = [(name, _shown("{:.1f}".format, value)) for name, value in seconds.items()]
        sections.append(TableSection("Time", ("stage", "seconds"), rows))
    return sections


def _shown(show: Show, value: object) -> str:
    """Format an entry of the summary; empty if it is none, or malformed."""
    try:
        return "" if value is None else show(value)
    except UNUSABLE:
        return ""


def _time(value: object) -> str:
    return duration(value) if isinstance(value, int | float) else ""


def _count(value: object) -> str:
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else ""


def _present(value: object) -> str:
    """Format a count; empty if it is 0."""
    return _count(value) if value else ""


def _memory(value: object) -> str:
    return f"{value / 2**20:.0f} MiB" if isinstance(value, int | float) else ""


def _rates(value: object) -> str:
    if not isinstance(value, Mapping):
        return ""
    return ", ".join(f"{rate:.2f} {name.replace('_', ' ')}" for name, rate in value.items())


def _spans(value: object) -> str:
    if not isinstance(value, list) or not value:
        return ""
    shown = ", ".join(f"{first:.1f} to {last:.1f}" for first, last in value[:5])
    return shown + (f" and {len(value) - 5} more" if len(value) > 5 else "")


def _yes(value: object) -> str:
    return "yes" if value else ""


_RUN_ROWS = (
    ("source", "source", str),
    ("format", "kind", str),
    ("frames", "frames", _count),
    ("keyframes", "keyframes", _count),
    ("skipped images", "skipped_images", _present),
    ("lost (s)", "lost_spans", _spans),
    ("only the orientation known (s)", "orientation_only_spans", _spans),
    ("disks", "disks", _count),
    ("mesh faces", "mesh_faces", _count),
    ("frames per second", "frames_per_second", _rates),
    ("computed on", "device", str),
    ("peak memory", "peak_memory_bytes", _memory),
    ("peak GPU memory", "peak_gpu_memory_bytes", _memory),
    ("intrinsics", "intrinsics", str),
    ("scale", "scale", str),
    ("stopped early", "interrupted", _yes),
    ("seed", "seed", str),
)


def lengths(summary: Mapping[str, Any]) -> Lengths:
    """Metres where ``scale`` in ``summary.json`` is metric, else units of the sequence."""
    scale = summary.get("scale")
    said = scale if isinstance(scale, str) else ""
    kind, _, rest = said.partition(" (")
    origin = rest.removesuffix(")")
    if kind == "metric":
        return Lengths(1.0, f"Metres by {origin}{_uncertain(summary.get('metric_scale'))}.")
    if kind == "of the poses":
        metres = METRES.get(origin)
        what = "Metres by the poses that were given" if metres else "Units of the poses given"
        return Lengths(metres, f"{what}.")
    note = "The images alone do not tell metres: lengths are in units of this sequence."
    return Lengths(None, note)


def _uncertain(metric: object) -> str:
    """Relative uncertainty of the scale, two standard deviations."""
    deviation = metric.get("deviation") if isinstance(metric, Mapping) else None
    if not isinstance(deviation, int | float) or not 0 < deviation < 1:
        return ""
    return f", to about {200 * deviation:.2g} %"
