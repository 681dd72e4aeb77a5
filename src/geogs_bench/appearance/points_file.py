"""Start points in a PLY file."""

from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.io.writers.ply import write_mesh
from geogs_bench.appearance.start_points import StartPoints


def write_points(path: str | Path, points: StartPoints) -> None:
    """Write positions (float32) and colours."""
    write_mesh(path, points.positions, np.zeros((0, 3), np.int32), points.colours)


def read_points(path: str | Path) -> StartPoints:
    """Read points with colours; grey where the file has none.

    Raises:
        InputError: there is no such file, or it is none of points.
    """
    from plyfile import PlyData, PlyParseError

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; give a PLY file of points.")
    try:
        vertex = PlyData.read(str(path))["vertex"].data
        positions = np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float64)
    except (PlyParseError, KeyError, ValueError) as error:
        raise InputError(f"{path} is no PLY file of points ({error}).") from None
    names = ("red", "green", "blue")
    if set(names) <= set(vertex.dtype.names or ()):
        colours = np.stack([vertex[name] for name in names], 1).astype(np.uint8)
    else:
        colours = np.full((len(positions), 3), 128, np.uint8)
    finite = np.isfinite(positions).all(1)
    return StartPoints(positions[finite], colours[finite])
