"""A recording of Stray Scanner: ``rgb.mp4`` with ``depth/000000.png`` for each of its frames."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.documents import read_text
from geogs.errors import InputError
from geogs.io.sources.base import RawFrame
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.video import VideoFile

_PER_METRE = 1000.0


class StrayRecording(VideoFile):
    """Reader of the video with the depth, of fewer pixels, that belongs to each frame."""

    kind = "stray"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "rgb.mp4")
        self.name = folder.resolve().name
        found = (p for p in (folder / "depth").glob("*.png") if p.stem.isdecimal())
        self._depths = {int(path.stem): DepthFile(path, _PER_METRE) for path in found}
        self.has_depth = bool(self._depths) and self.quarter_turns == 0
        matrix = folder / "camera_matrix.csv"
        if matrix.is_file():
            self.calibration = _calibration(matrix, self.width, self.height)

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read frames ``start, start + stride, ...`` before ``stop``."""
        for n, raw in enumerate(super().read(start, stop, stride)):
            yield replace(raw, depth=self._depths.get(start + n * stride))


def _calibration(path: Path, width: int, height: int) -> Calibration:
    try:
        rows = [[float(x) for x in line.split(",")] for line in read_text(path).split()]
        K = np.array(rows).reshape(3, 3)
    except ValueError:
        raise InputError(f"{path} should hold a 3x3 camera matrix; copy it again.") from None
    return Calibration(
        K[0, 0], K[1, 1], K[0, 2], K[1, 2], width=width, height=height, origin="Stray Scanner"
    )
