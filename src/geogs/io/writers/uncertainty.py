"""A table of the uncertainty of every frame."""

from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.atomic import write_text
from geogs.guard.documents import read_text
from geogs.types import Trajectory, Uncertainty

HEADER = "timestamp,state,sigma_position,sigma_rotation_deg,relative_sigma_depth"


def write_uncertainty(path: str | Path, trajectory: Trajectory, known: Uncertainty) -> None:
    """Write a row per frame: its state and standard deviations as of ``Uncertainty``.

    The state is tracked, orientation only or lost. Between the frames of ``known``, deviations are
    interpolated in time; a frame that is not tracked has none.
    """
    at = trajectory.timestamps
    there = known.at(at)
    columns = there.position, np.degrees(there.rotation), there.depth
    rows = [HEADER]
    for n, state in enumerate(trajectory.states):
        numbers = [f"{c[n]:.6g}" if state == "tracked" else "" for c in columns]
        rows.append(",".join([repr(float(at[n])), state, *numbers]))
    write_text(path, "\n".join([*rows, ""]))


def moved_rows(path: Path, factor: float, shift: float = 0.0) -> list[str]:
    """Read the rows of a table, without header, scaled to another unit of length and ``shift``
    seconds later; none where there is no table.

    Raises InputError if it is damaged.
    """
    if not path.is_file():
        return []
    rows = []
    try:
        for line in read_text(path).splitlines()[1:]:
            cells = line.split(",")
            cells[0] = repr(float(cells[0]) + shift)
            if len(cells) > 2 and cells[2]:
                cells[2] = f"{factor * float(cells[2]):.6g}"
            rows.append(",".join(cells))
    except ValueError:
        raise InputError(f"{path} is damaged; leave it out.") from None
    return rows


def read_states(path: Path) -> list[tuple[float, str, float]]:
    """Read time, state and standard deviation of the position (infinite where none is given) of
    every frame from the table of a run. Raises InputError if it is damaged."""
    try:
        cells = [row.split(",") for row in read_text(path).splitlines()[1:]]
        return [(float(row[0]), row[1], float(row[2] or "inf")) for row in cells]
    except (ValueError, IndexError):
        raise InputError(f"{path} is damaged; leave it out.") from None
