"""Start points in a PLY file."""

from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.io.ply_reader import PlyElement, read_ply
from geogs.io.writers.ply_writer import write_points as write_coloured_points
from geogs_bench.appearance.start_points import StartPoints


def write_points(path: str | Path, points: StartPoints) -> None:
    """Write positions (float32) and colours."""
    write_coloured_points(path, points.positions, points.colours)


def read_points(path: str | Path) -> StartPoints:
    """Read points with colours; grey where the file has none.

    Raises:
        InputError: there is no such file, or it is none of points.
    """
    vertex = read_ply(path).get("vertex", PlyElement({}, {})).columns
    if not {"x", "y", "z"} <= vertex.keys():
        raise InputError(f"{path} is no PLY file of points.")
    positions = np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], 1)
    names = ("red", "green", "blue")
    if set(names) <= vertex.keys():
        colours = np.stack([vertex[name] for name in names], 1).astype(np.uint8)
    else:
        colours = np.full((len(positions), 3), 128, np.uint8)
    finite = np.isfinite(positions).all(1)
    return StartPoints(positions[finite], colours[finite])
