"""The ASL layout of EuRoC and TUM-VI: ``mav0/cam0/data.csv``, ``data/*.png`` and ``sensor.yaml``.

Times are nanoseconds; ``T_BS`` of ``sensor.yaml`` takes the camera's axes to the body's. The truth
is the body's: ``mav0/state_groundtruth_estimate0/data.csv`` (EuRoC) or ``mav0/mocap0/data.csv``
(TUM-VI), rows that begin with time, position and quaternion (w first). TUM-VI has its cameras in
``dso/camchain.yaml``, with ``T_cam_imu`` from the body to the camera.
https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, first_file
from geogs.io.pose_files import is_rigid, quaternion_trajectory, read_rows
from geogs.io.sources.calibration_files import calibration_from_document, camera_document
from geogs.io.sources.formats.image_files import (
    ImageFile,
    ImageList,
    Place,
    images_in,
    in_order_of_time,
    listed,
)
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.types import Trajectory

PICTURES = tuple(f"mav0/cam{number}/data" for number in range(4))
"""Folders of images, those of the left camera first."""
_TRUTHS = ("state_groundtruth_estimate0", "mocap0")
_COLUMNS = (8, 17)
"""Column counts: time, position, quaternion; EuRoC adds velocity and biases."""
_NANOSECONDS = 1e-9


def open_asl(place: Place) -> ImageList:
    """Read the images of one camera; times are those of its ``data.csv``."""
    camera = place.pictures.parent
    listing = camera / "data.csv"
    if listing.is_file():
        files = listed(listing, _row, "nanoseconds and a file", between=",")
    else:
        files = in_order_of_time(images_in(place.pictures))
    name = f"{place.folder.resolve().name}-{camera.name}"
    found = _description(camera)
    if found is None:
        return ImageList("asl", name, files, None)
    file, document = found
    try:
        return ImageList("asl", name, files, calibration_from_document(document, file))
    except UNUSABLE:
        raise InputError(f"{file} describes no camera that can be understood.") from None


def open_posed_asl(place: Place) -> PosedSet:
    """Read the images of one camera with its poses."""
    above = place.pictures.parent.parent
    files = [above / name / "data.csv" for name in _TRUTHS]
    truth = first_file(files)
    if truth is None:
        raise InputError(
            f"{place.folder} holds no true poses: there is neither {files[0]} nor "
            f"{files[1].relative_to(above)}."
        )
    images = open_asl(place)
    return with_timed_poses(images, _truth_of(truth, place.pictures.parent))


def is_asl_truth(path: Path) -> bool:
    """Whether ``path`` is a table of poses in this layout."""
    return path.name == "data.csv"


def read_asl_truth(path: Path) -> Trajectory:
    """Read the poses of the first camera beside the table; of the body where there is none."""
    return _truth_of(path, path.absolute().parent.parent / "cam0")


def _truth_of(path: Path, camera: Path) -> Trajectory:
    rows = read_rows(path, _COLUMNS, "time [ns], position, quaternion (w first)")
    trajectory = quaternion_trajectory(
        path, rows[:, 0] * _NANOSECONDS, rows[:, 1:4], rows[:, [5, 6, 7, 4]]
    )
    return Trajectory(
        trajectory.timestamps, trajectory.T_wc @ _body_from_camera(camera), trajectory.tracked
    )


def _body_from_camera(camera: Path) -> Float64[np.ndarray, "4 4"]:
    """The pose of a camera in the body frame; the identity where no file describes it."""
    found = _description(camera)
    if found is None:
        return np.eye(4)
    file, document = found
    try:
        if "T_cam_imu" in document:
            T = np.linalg.inv(np.array(document["T_cam_imu"], dtype=np.float64).reshape(4, 4))
        else:
            T = np.array(document["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
        if not is_rigid(T[None])[0]:
            raise ValueError
    except UNUSABLE:
        raise InputError(
            f"{file} does not say where the camera is (T_BS); copy it again."
        ) from None
    return T


def _description(camera: Path) -> tuple[Path, dict[str, Any]] | None:
    """The file that describes a camera, and its content."""
    chain = camera.parent.parent / "dso" / "camchain.yaml"
    file = first_file((camera / "sensor.yaml", chain))
    if file is None:
        return None
    try:
        return file, camera_document(file, camera.name)
    except UNUSABLE:
        raise InputError(f"{file} describes no camera that can be understood.") from None


def _row(folder: Path, words: list[str]) -> ImageFile:
    """An image of a row such as ``1403636579763555584,1403636579763555584.png``."""
    time, name = words
    if not re.fullmatch(r"[0-9]{1,20}", time) or not name:
        raise ValueError
    return ImageFile(folder / "data" / name, int(time) * _NANOSECONDS)
