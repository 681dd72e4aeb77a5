"""Point clouds as LAS, for surveyors' programs."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from geogs.errors import InputError
from geogs.extras import install_command
from geogs.guard.atomic import atomic_file

_STEPS = 1e9
"""Steps of a coordinate over the extent, within the 32 bits of LAS."""


def write_las(
    path: Path, positions: Float64[np.ndarray, "n 3"], colours: UInt8[np.ndarray, "n 3"]
) -> None:
    """Write LAS 1.2, point format 2; colours have 16 bits there.

    Raises:
        InputError: laspy is not installed.
        OutputError: the file cannot be written.
    """
    try:
        import laspy
    except ImportError:
        raise InputError(f"LAS needs laspy: {install_command('export')}") from None
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets = positions.min(axis=0)
    extent = float(np.ptp(positions, axis=0).max())
    header.scales = np.full(3, 10.0 ** np.ceil(np.log10(max(extent, 1e-9) / _STEPS)))
    las = laspy.LasData(header)
    las.x, las.y, las.z = positions.T
    las.red, las.green, las.blue = colours.T.astype(np.uint16) * 257
    with atomic_file(path) as stream:
        las.write(stream, do_compress=False)
