"""KITTI: odometry (``sequences/00/image_0 ... image_3``) and raw (``image_02/data``).

Odometry: ``calib.txt`` and ``times.txt`` lie beside the images, the pose of camera 0 at each image
in a row of ``poses/00.txt``, one or two levels up. Raw: ``timestamps.txt`` beside ``data``, and
``calib_cam_to_cam.txt`` above. https://www.cvlibs.net/datasets/kitti
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from geogs.documents import UNUSABLE, read_text
from geogs.errors import InputError
from geogs.io.pose_files import is_rigid, matrix_trajectory, read_rows
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.data_set_cameras import kitti_camera, kitti_offset
from geogs.io.sources.formats.image_files import (
    ImageFile,
    ImageList,
    Place,
    holds_pictures,
    images_in,
)
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.types import Trajectory

ODOMETRY = ("image_2", "image_0", "image_3", "image_1")
"""Folders of images, those of the left colour camera first."""
RAW = tuple(f"image_{number:02d}/data" for number in (2, 0, 3, 1))
_FRAMES_PER_SECOND = 10.0
"""Of the data set, where the file of times is missing."""


def is_kitti_odometry(folder: Path) -> bool:
    """Whether ``folder`` is a sequence of the odometry benchmark."""
    return holds_pictures(folder, ODOMETRY)


def is_kitti_raw(folder: Path) -> bool:
    """Whether ``folder`` is a drive of the raw data."""
    return holds_pictures(folder, RAW)


def open_kitti_odometry(place: Place) -> ImageList:
    """Read the images of one camera; times are those of ``times.txt``."""
    number = int(place.pictures.name[-1])
    listing, calib = place.folder / "times.txt", place.folder / "calib.txt"
    times = _seconds(listing) if listing.is_file() else None
    camera = _camera(calib, number) if calib.is_file() else None
    name = f"{place.folder.resolve().name}-{place.pictures.name}"
    return ImageList("kitti", name, _timed(place.pictures, times, listing), camera)


def open_kitti_raw(place: Place) -> ImageList:
    """Read the images of one camera; times are those of ``timestamps.txt``, by the epoch."""
    number = int(place.pictures.parent.name[-2:])
    listing = place.pictures.parent / "timestamps.txt"
    times = _dates(listing) if listing.is_file() else None
    name = f"{place.folder.resolve().name}-{place.pictures.parent.name}"
    images = ImageList("kitti-raw", name, _timed(place.pictures, times, listing), None)
    above = (place.folder, place.folder.resolve().parent)
    calib = next((p for f in above if (p := f / "calib_cam_to_cam.txt").is_file()), None)
    if calib is not None:
        images.info = replace(images.info, calibration=_raw_camera(calib, number, images))
    return images


def open_posed_kitti_odometry(place: Place) -> PosedSet:
    """Read the images of one camera with its poses."""
    images = open_kitti_odometry(place)
    folder = place.folder.resolve()
    name = f"{folder.name}.txt"
    above = (folder, folder.parent, folder.parent / "poses", folder.parent.parent / "poses")
    file = next((place / name for place in above if (place / name).is_file()), None)
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
    """Whether ``path`` has poses of the odometry benchmark, and the times of their images lie in
    the sequence of that name."""
    return path.suffix == ".txt" and _sequence_of(path) is not None


def read_kitti_truth(path: Path) -> Trajectory:
    """Read the poses of camera 0 at the times of its images."""
    folder = _sequence_of(path)
    assert folder is not None
    return _poses(path, folder)


def _sequence_of(path: Path) -> Path | None:
    path = path.absolute()
    above = (path.parent, path.parent / "sequences", path.parent.parent / "sequences")
    places = (folder / path.stem for folder in (*above, path.parent.parent))
    return next((place for place in places if (place / "times.txt").is_file()), None)


def _poses(file: Path, folder: Path) -> Trajectory:
    rows = read_rows(file, (12,), "the upper 3x4 of a matrix a row")
    times = folder / "times.txt"
    seconds = _seconds(times) if times.is_file() else np.arange(len(rows)) / _FRAMES_PER_SECOND
    if len(rows) > len(seconds):
        raise InputError(
            f"{file} holds {len(rows)} poses for the {len(seconds)} times of {times}; are they of "
            "one sequence?"
        )
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, :3] = rows.reshape(-1, 3, 4)
    return matrix_trajectory(file, seconds[: len(rows)], T_wc, is_rigid(T_wc))


def _timed(pictures: Path, times: np.ndarray | None, listing: Path) -> list[ImageFile]:
    """Images with the time in the row of their number."""
    numbered = sorted((int(p.stem), p) for p in images_in(pictures) if _is_number(p.stem))
    if not numbered:
        raise InputError(f"{pictures} holds no images that are numbered, such as 000000.png.")
    if times is None:
        return [ImageFile(path, k / _FRAMES_PER_SECOND) for k, path in numbered]
    if numbered[-1][0] >= len(times):
        raise InputError(
            f"{listing} has {len(times)} times, but the images are numbered up to "
            f"{numbered[-1][0]}; copy it again."
        )
    return [ImageFile(path, float(times[k])) for k, path in numbered]


def _is_number(stem: str) -> bool:
    return re.fullmatch(r"[0-9]{1,12}", stem) is not None


def _seconds(listing: Path) -> np.ndarray:
    seconds = read_rows(listing, (1,), "a time in seconds a row")[:, 0]
    if not (np.isfinite(seconds).all() and (np.diff(seconds) > 0).all()):
        raise InputError(f"{listing} holds times that do not rise; copy it again.")
    return seconds


def _dates(listing: Path) -> np.ndarray:
    """Seconds since 1970 of rows such as ``2011-09-26 13:02:25.964389445``."""
    return np.array(list(_epochs(read_text(listing).splitlines(), listing)))


def _epochs(lines: Iterable[str], listing: Path) -> Iterable[float]:
    for number, line in enumerate(lines, start=1):
        try:
            whole, _, fraction = line.strip().partition(".")
            date = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            yield date.timestamp() + float(f"0.{fraction or 0}")
        except ValueError:
            raise InputError(f"{listing}, line {number}: expected a date and a time.") from None


def _camera(path: Path, number: int, rectified: bool = True) -> Calibration:
    try:
        return kitti_camera(path, number, rectified)
    except UNUSABLE:
        raise InputError(f"{path} is no calibration of KITTI; copy it again.") from None


def _raw_camera(path: Path, number: int, images: ImageList) -> Calibration:
    """The rectified camera, or where the images have another size, as they have before, that."""
    rectified = _camera(path, number)
    size = (images.info.width, images.info.height)
    if (rectified.width, rectified.height) in (size, (None, None)):
        return rectified
    return _camera(path, number, rectified=False)
