"""The page of a run: what happened in numbers, and the pictures that need no truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from geogs.evaluation.page import PictureSection, Section, TableSection, write_page

PICTURES = {
    "mesh.png": "Mesh",
    "keyframes.png": "Rendered keyframes",
    "trajectory.png": "Trajectory",
}
"""Titles of the pictures that a run leaves in ``report/``, in the order of the page."""


def write_run_page(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write ``index.html`` into the folder of the pictures.

    Args:
        folder: ``report/`` of a result.
        summary: what ``summary.json`` holds; numbers that are not there are left out.

    Raises:
        OutputError: it cannot be written.
    """
    pictures = [PictureSection(title, folder / name) for name, title in PICTURES.items()]
    name = str(summary.get("source", ""))
    first, *others = run_sections(summary)
    write_page(folder / "index.html", f"geogs: {name}", [first, *pictures, *others])


def run_sections(summary: Mapping[str, Any]) -> list[Section]:
    """Tables of what ``summary.json`` holds: the run, and the seconds of its stages."""
    facts = [(title, text) for title, key, show in _FACTS if (text := show(summary.get(key))) != ""]
    sections: list[Section] = [TableSection("The run", (), facts)]
    seconds = summary.get("seconds")
    if isinstance(seconds, Mapping):
        rows = [(name, f"{value:.1f}") for name, value in seconds.items()]
        sections.append(TableSection("Time", ("stage", "seconds"), rows))
    return sections


def _plain(value: object) -> str:
    return "" if value is None else str(value)


def _count(value: object) -> str:
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else ""


def _present(value: object) -> str:
    """A number that is worth a line only if it is not 0."""
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


_FACTS = (
    ("source", "source", _plain),
    ("format", "kind", _plain),
    ("frames", "frames", _count),
    ("keyframes", "keyframes", _count),
    ("skipped images", "skipped_images", _present),
    ("lost (s)", "lost_spans", _spans),
    ("only the orientation known (s)", "orientation_only_spans", _spans),
    ("disks", "disks", _count),
    ("mesh faces", "mesh_faces", _count),
    ("frames per second", "frames_per_second", _rates),
    ("computed on", "device", _plain),
    ("peak memory", "peak_memory_bytes", _memory),
    ("peak GPU memory", "peak_gpu_memory_bytes", _memory),
    ("intrinsics", "intrinsics", _plain),
    ("scale", "scale", _plain),
    ("stopped early", "interrupted", _yes),
    ("seed", "seed", _plain),
)
