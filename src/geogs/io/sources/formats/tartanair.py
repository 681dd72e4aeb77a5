"""TartanAir: ``image_left/000000_left.png``, and the pose of image k in row k of ``pose_left.txt``.

The axes of world and camera are north, east, down: x forward, y right, z down. All cameras see 90
degrees. The second version has ``image_lcam_front`` with ``pose_lcam_front.txt`` and so on.
https://github.com/castacks/tartanair_tools/blob/master/data_type.md
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import numbered
from geogs.io.pose_files import FRAMES_PER_SECOND, quaternion_trajectory, read_rows
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.image_files import ImageFile, ImageList, Place, images_in
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.types import Trajectory

_SIDES = ("front", "back", "left", "right", "top", "bottom")
PICTURES = (
    "image_left",
    "image_right",
    *(f"image_{eye}cam_{side}" for side in _SIDES for eye in "lr"),
)
"""Folders of images, one for each camera."""
_OPENCV_FROM_NED = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
_NAME = re.compile(r"([0-9]{1,12})_\w+\.\w+")


def open_tartanair(place: Place) -> ImageList:
    """Read the images of one camera; image k is at k / 30 s, for there are no times."""
    pictures = numbered(images_in(place.pictures), _NAME)
    if not pictures:
        raise InputError(f"{place.pictures} holds no images such as 000000_left.png.")
    files = [ImageFile(path, k / FRAMES_PER_SECOND) for k, path in pictures]
    name = "-".join(place.folder.resolve().parts[1:][-3:])  # scene, level, path
    images = ImageList("tartanair", name, files, None)
    width, height = images.info.width, images.info.height
    calibration = Calibration(
        width / 2,
        width / 2,
        (width - 1) / 2,
        (height - 1) / 2,
        width=width,
        height=height,
        origin="the TartanAir data set",
    )
    images.info = replace(images.info, calibration=calibration)
    return images


def open_posed_tartanair(place: Place) -> PosedSet:
    """Read the images of one camera with their poses."""
    file = place.folder / f"pose_{place.pictures.name.removeprefix('image_')}.txt"
    if not file.is_file():
        raise InputError(f"{place.folder} holds no true poses: {file.name} is missing.")
    return with_timed_poses(open_tartanair(place), read_tartanair_truth(file))


def is_tartanair_truth(path: Path) -> bool:
    """Whether ``path`` has the name of a pose file."""
    return f"image_{path.stem.removeprefix('pose_')}" in PICTURES and path.suffix == ".txt"


def read_tartanair_truth(path: Path) -> Trajectory:
    """Read rows ``tx ty tz qx qy qz qw`` in axes north, east, down; row k is at k / 30 s."""
    rows = read_rows(path, (7,), "tx ty tz qx qy qz qw")
    seconds = np.arange(len(rows)) / FRAMES_PER_SECOND
    ned = quaternion_trajectory(path, seconds, rows[:, :3], rows[:, 3:])
    T_wc = _OPENCV_FROM_NED @ ned.T_wc @ _OPENCV_FROM_NED.T
    return Trajectory(ned.timestamps, T_wc, ned.tracked)
