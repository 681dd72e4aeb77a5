"""Kapture: ``sensors/`` with cameras, records and trajectories, comma-separated.

Poses are world to sensor, quaternions w x y z; cameras are COLMAP's, the first pixel's centre
(0.5, 0.5). https://github.com/naver/kapture/blob/main/kapture_format.adoc
"""

from pathlib import Path

import numpy as np

from geogs.guard.documents import read_text
from geogs.io.sources.account import Account
from geogs.io.sources.calibration_files import calibration_from_colmap
from geogs.io.sources.formats.colmap import pose_from
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    find_file,
    posed_set,
    understood,
)
from geogs.io.sources.posed.posed_set import PosedSet


def find_kapture(path: Path) -> Path | None:
    """The list of sensors of a folder, or none; ``path`` may be the file."""
    return find_file(path, ("sensors/sensors.txt", "mapping/sensors/sensors.txt"), b"# kapture")


def open_kapture(file: Path) -> PosedSet:
    """Read the images whose camera has a pose of its own at their time.

    Raises:
        InputError: a table is missing or cannot be understood.
    """
    place = file.parent
    with understood(place, "copy its tables again"):
        cameras = {row[0]: _camera(row[3:], file) for row in _rows(file) if row[2] == "camera"}
        poses = {(int(row[0]), row[1]): row[2:] for row in _rows(place / "trajectories.txt")}
        records = [(int(row[0]), row[1], row[2]) for row in _rows(place / "records_camera.txt")]
        posed = [(name, device, poses.get((t, device), [""])) for t, device, name in records]
        views = [View(n, _pose(words), cameras[device]) for n, device, words in posed if all(words)]
    without = [name for name, _, words in posed if not all(words)]
    rigs = place / "rigs.txt"
    account = Account(left=(f"poses of rigs, of {rigs}",) if rigs.is_file() else ())
    return posed_set("kapture", file, views, without, account, place / "records_data")


def _rows(path: Path) -> list[list[str]]:
    lines = (line.strip() for line in read_text(path).splitlines())
    return [[w.strip() for w in row.split(",")] for row in lines if row and row[0] != "#"]


def _camera(words: list[str], file: Path) -> SizedCamera | None:
    model, width, height, *parameters = words
    if model == "UNKNOWN_CAMERA":
        return None
    numbers = [float(word) for word in parameters]
    size = int(width), int(height)
    return lambda width, height: calibration_from_colmap(model, *size, numbers, str(file))


def _pose(words: list[str]) -> np.ndarray:
    numbers = [float(word) for word in words]
    return pose_from(numbers[:4], numbers[4:])
