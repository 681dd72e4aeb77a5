"""Outcome of one source: a row of the fleet's table."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, get_args

from geogs.documents import UNUSABLE

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
