"""KITTI's odometry benchmark: ``sequences/00/image_0 ... image_3``, ``calib.txt``, ``times.txt``.

The pose of camera 0 at each image is a row of ``poses/00.txt``, one or two levels up.
https://www.cvlibs.net/datasets/kitti/eval_odometry.php
"""

import re
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, first_file, numbered
from geogs.io.pose_files import columns_of, is_rigid, matrix_trajectory, read_rows
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.data_set_cameras import kitti_camera, kitti_offset
from geogs.io.sources.formats.image_files import ImageFile, ImageList, Place, images_in
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.types import Trajectory

ODOMETRY = ("image_2", "image_0", "image_3", "image_1")
"""Folders of images, those of the left colour camera first."""
_NAME = re.compile(r"([0-9]{1,12})\.\w+")
_MATRIX = (12, 16)
"""Numbers of a matrix in a row, without and with its last row."""
_FRAMES_PER_SECOND = 10.0
"""Rate of the data set, where the file of times is missing."""


def open_kitti_odometry(place: Place) -> ImageList:
    """Read the images of one camera; times are those of ``times.txt``."""
    number = int(place.pictures.name[-1])
    listing = place.folder / "times.txt"
    calib = place.folder / "calib.txt"
    times = _seconds(listing) if listing.is_file() else None
    camera = camera_of(calib, number) if calib.is_file() else None
    name = f"{place.folder.resolve().name}-{place.pictures.name}"
    return ImageList("kitti", name, timed(place.pictures, times, listing), camera)


def open_posed_kitti_odometry(place: Place) -> PosedSet:
    """Read the images of one camera with its poses."""
    images = open_kitti_odometry(place)
    folder = place.folder.resolve()
    name = f"{folder.name}.txt"
    above = (folder, folder.parent, folder.parent / "poses", folder.parent.parent / "poses")
    file = first_file(place / name for place in above)
    if file is None:
        raise InputError(
            f"{folder} is a sequence of KITTI without true poses: {name} is in none of "
            f"{above[2]} and {above[3]}."
        )
    trajectory = _poses(file, folder)
    calib = folder / "calib.txt"
    if calib.is_file():  # from camera 0 to the one that is read
        shift = kitti_offset(calib, int(place.pictures.name[-1]))
        trajectory.T_wc[:, :3, 3] -= trajectory.T_wc[:, :3, :3] @ shift
    return with_timed_poses(images, trajectory)


def is_kitti_truth(path: Path) -> bool:
    """Whether ``path`` has a matrix a row, and the sequence of that name, or its own folder, has
    the times of the images."""
    return path.suffix == ".txt" and _sequence_of(path) is not None


def read_kitti_truth(path: Path) -> Trajectory:
    """Read the poses of camera 0 at the times of its images."""
    folder = _sequence_of(path)
    assert folder is not None
    return _poses(path, folder)


def _sequence_of(path: Path) -> Path | None:
    path = path.absolute()
    above = (path.parent, path.parent / "sequences", path.parent.parent / "sequences")
    named = [folder / path.stem for folder in (*above, path.parent.parent)]
    places = [place for place in (*named, path.parent) if (place / "times.txt").is_file()]
    if not places or (places[0] == path.parent and columns_of(path) not in _MATRIX):
        return None
    return places[0]


def _poses(file: Path, folder: Path) -> Trajectory:
    rows = read_rows(file, _MATRIX, "the upper 3x4 of a matrix a row")
    times = folder / "times.txt"
    seconds = _seconds(times) if times.is_file() else np.arange(len(rows)) / _FRAMES_PER_SECOND
    if len(rows) > len(seconds):
        raise InputError(
            f"{file} holds {len(rows)} poses for the {len(seconds)} times of {times}; are they of "
            "one sequence?"
        )
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, :3] = rows[:, :12].reshape(-1, 3, 4)
    return matrix_trajectory(file, seconds[: len(rows)], T_wc, is_rigid(T_wc))


def timed(pictures: Path, times: np.ndarray | None, listing: Path) -> list[ImageFile]:
    """Images with the time in the row of their number; ten per second without times.

    Raises:
        InputError: there are no numbered images, or more than times.
    """
    images = numbered(images_in(pictures), _NAME)
    if not images:
        raise InputError(f"{pictures} holds no images that are numbered, such as 000000.png.")
    if times is None:
        return [ImageFile(path, k / _FRAMES_PER_SECOND) for k, path in images]
    if images[-1][0] >= len(times):
        raise InputError(
            f"{listing} has {len(times)} times, but the images are numbered up to "
            f"{images[-1][0]}; copy it again."
        )
    return [ImageFile(path, float(times[k])) for k, path in images]


def _seconds(listing: Path) -> np.ndarray:
    seconds = read_rows(listing, (1,), "a time in seconds a row")[:, 0]
    if not (np.isfinite(seconds).all() and (np.diff(seconds) > 0).all()):
        raise InputError(f"{listing} holds times that do not rise; copy it again.")
    return seconds


def camera_of(path: Path, number: int, rectified: bool = True) -> Calibration:
    """Read camera ``number`` of a KITTI file. Raises InputError where it is no calibration."""
    try:
        return kitti_camera(path, number, rectified)
    except UNUSABLE:
        raise InputError(f"{path} is no calibration of KITTI; copy it again.") from None
