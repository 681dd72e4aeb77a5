"""A recording of Stray Scanner: ``rgb.mp4`` with a depth, a confidence and a pose for each frame.

https://github.com/strayrobots/scanner/blob/main/docs/format.md
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import numbered, read_text
from geogs.io.pose_files import poses_from
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import PHONE, DepthFile
from geogs.io.sources.formats.video_file import VideoFile
from geogs.io.sources.pose_priors import rigid_pose
from geogs.io.sources.reader import RawFrame
from geogs.types import MeasuredPose

_COLUMNS = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")


def is_stray(folder: Path) -> bool:
    """Whether ``folder`` is a recording."""
    beside = (folder / "depth").is_dir() or (folder / "odometry.csv").is_file()
    return (folder / "rgb.mp4").is_file() and beside


class StrayRecording(VideoFile):
    """Reader of the video with the low-resolution depth and the pose of each frame.

    Poses are ARKit's, camera to world, of the frames as they are stored.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "rgb.mp4")
        turns = self.info.quarter_turns
        depths = numbered((folder / "depth").glob("*.png"))
        self._depths = {number: _depth(folder, path, turns) for number, path in depths}
        matrix = folder / "camera_matrix.csv"
        odometry = folder / "odometry.csv"
        stored = (self.info.width, self.info.height)[:: -1 if turns % 2 else 1]
        self._poses = _poses(odometry, turns) if odometry.is_file() else {}
        self.info = replace(
            self.info,
            kind="stray",
            name=folder.resolve().name,
            calibration=_calibration(matrix, *stored) if matrix.is_file() else None,
            depths=len(self._depths),
            depth_sample=tuple(self._depths.values()),
            has_poses=bool(self._poses),
            is_capture=True,
        )

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read frames ``start, start + stride, ...`` before ``stop``."""
        for n, raw in enumerate(super().read(start, stop, stride)):
            at = start + n * stride
            yield replace(raw, depth=self._depths.get(at), pose=self._poses.get(at))


def _depth(folder: Path, path: Path, quarter_turns: int) -> DepthFile:
    confidence = folder / "confidence" / path.name
    known = confidence if confidence.is_file() else None
    return DepthFile(path, PHONE, confidence=known, quarter_turns=quarter_turns)


def _poses(path: Path, quarter_turns: int) -> dict[int, MeasuredPose]:
    """Poses by frame number; rows without a pose are left out."""
    header, *lines = read_text(path).splitlines() or [""]
    names = [name.strip() for name in header.split(",")]
    try:
        at = [names.index(name) for name in _COLUMNS]
        rows = [[float(words[k]) for k in at] for line in lines if (words := line.split(","))[1:]]
    except (ValueError, IndexError):
        raise InputError(
            f"{path} should have the columns {', '.join(_COLUMNS)}; copy it again."
        ) from None
    found = {}
    for number, *values in rows:
        row = np.array([values])
        if not (np.isfinite(number) and np.isfinite(row[:, 3:]).all() and row[:, 3:].any()):
            continue
        pose = rigid_pose(poses_from(row[:, :3], row[:, 3:])[0], quarter_turns)
        if pose is not None:
            found[int(number)] = pose
    return found


def _calibration(path: Path, width: int, height: int) -> Calibration:
    """The camera of the images as they are stored."""
    try:
        rows = [[float(x) for x in line.split(",")] for line in read_text(path).split()]
        K = np.array(rows).reshape(3, 3)
    except ValueError:
        raise InputError(f"{path} should hold a 3x3 camera matrix; copy it again.") from None
    return Calibration(
        K[0, 0], K[1, 1], K[0, 2], K[1, 2], width=width, height=height, origin="Stray Scanner"
    )
