"""KITTI's raw data: ``image_00/data ... image_03/data`` of a drive, with ``timestamps.txt`` beside.

``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt`` and ``calib_imu_to_velo.txt`` lie in the folder
of the day, above. The truth is that of the GPS and inertial unit, ``oxts/data``: latitude,
longitude, altitude, roll, pitch and yaw, brought to metres by a Mercator projection and to the
rectified camera by the calibrations (Geiger et al., "Vision meets robotics", IJRR 2013).
"""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import first_file, read_text
from geogs.io.pose_files import is_rigid, matrix_trajectory, read_rows
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.data_set_cameras import kitti_offset, kitti_rows
from geogs.io.sources.formats.image_files import ImageList, Place, file_names
from geogs.io.sources.formats.kitti import camera_of, timed
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.types import Trajectory

RAW = tuple(f"image_{number:02d}/data" for number in (2, 0, 3, 1))
"""Folders of images, those of the left colour camera first."""
_EARTH = 6378137.0
"""Radius of the Earth in metres."""
_MAX_GAP = 0.25
"""Longest gap between two poses for interpolation, in seconds: there are ten a second."""


def open_kitti_raw(place: Place) -> ImageList:
    """Read the images of one camera; times are those of ``timestamps.txt``, by the epoch."""
    number = int(place.pictures.parent.name[-2:])
    listing = place.pictures.parent / "timestamps.txt"
    times = _dates(listing) if listing.is_file() else None
    name = f"{place.folder.resolve().name}-{place.pictures.parent.name}"
    images = ImageList("kitti-raw", name, timed(place.pictures, times, listing), None)
    calib = _above(place.folder, "calib_cam_to_cam.txt")
    if calib is not None:
        images.info = replace(images.info, calibration=_raw_camera(calib, number, images))
    return images


def open_posed_kitti_raw(place: Place) -> PosedSet:
    """Read the rectified images of one camera with the poses of the inertial unit at their times.

    Raises:
        InputError: a file is missing, or the images are not rectified.
    """
    images = open_kitti_raw(place)
    oxts = place.folder / "oxts"
    if not (oxts / "timestamps.txt").is_file() or not (oxts / "data").is_dir():
        raise InputError(f"{place.folder} holds no true poses: oxts with its data is missing.")
    if images.info.calibration is not None and images.info.calibration.distortion:
        raise InputError(
            f"The true poses of {place.folder} are those of rectified images; give these (_sync)."
        )
    camera_imu = _camera_from_imu(place.folder, int(place.pictures.parent.name[-2:]))
    trajectory = _imu_trajectory(oxts)
    T_wc = trajectory.T_wc @ np.linalg.inv(camera_imu)
    return with_timed_poses(
        images, Trajectory(trajectory.timestamps, T_wc, trajectory.tracked), _MAX_GAP
    )


def _imu_trajectory(oxts: Path) -> Trajectory:
    """Poses of the unit (x forward, y left, z up) from its axes to east, north and up."""
    from scipy.spatial.transform import Rotation

    times = _dates(oxts / "timestamps.txt")
    names = sorted(name for name in file_names(oxts / "data") if name.endswith(".txt"))
    if len(names) != len(times):
        raise InputError(f"{oxts} holds {len(names)} rows for {len(times)} times; copy it again.")
    rows = np.array([_six(oxts / "data" / name) for name in names]).reshape(-1, 6)
    latitude = np.radians(rows[:, 0])
    longitude = np.radians(rows[:, 1])
    altitude = rows[:, 2]
    scale = np.cos(latitude[0]) * _EARTH if len(rows) else _EARTH
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, 0, 3] = scale * longitude
    T[:, 1, 3] = scale * np.log(np.tan(np.pi / 4 + latitude / 2))
    T[:, 2, 3] = altitude
    T[:, :3, 3] -= T[:1, :3, 3]  # near the origin, to keep precision
    T[:, :3, :3] = Rotation.from_euler("xyz", rows[:, 3:]).as_matrix()  # roll, pitch, then yaw
    return matrix_trajectory(oxts, times, T, is_rigid(T))


def _six(file: Path) -> Float64[np.ndarray, "6"]:
    """Latitude and longitude in degrees, altitude in metres, roll, pitch and yaw in radians."""
    return read_rows(file, (30,), "30 numbers of the inertial unit")[0, :6]


def _camera_from_imu(folder: Path, number: int) -> Float64[np.ndarray, "4 4"]:
    """Transform from the unit's axes to those of a rectified camera, by the three calibrations."""
    T = np.eye(4)
    for name in ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt"):
        rows, file = _rows(folder, name)
        T = _motion(rows.get("R", []), rows.get("T", []), file) @ T
    rows, file = _rows(folder, "calib_cam_to_cam.txt")
    T = _motion(rows.get("R_rect_00", []), [0.0, 0.0, 0.0], file) @ T
    T[:3, 3] += kitti_offset(file, number)
    return T


def _rows(folder: Path, name: str) -> tuple[dict[str, list[float]], Path]:
    file = _above(folder, name)
    if file is None:
        raise InputError(f"{name} is missing beside or above {folder}; the true poses need it.")
    return kitti_rows(read_text(file)), file


def _motion(R: list[float], t: list[float], file: Path) -> Float64[np.ndarray, "4 4"]:
    T = np.eye(4)
    if len(R) == 9 and len(t) == 3:
        T[:3, :3] = np.reshape(R, (3, 3))
        T[:3, 3] = t
    if len(R) != 9 or len(t) != 3 or not is_rigid(T[None])[0]:
        raise InputError(f"{file} holds no rotation with its translation; copy it again.")
    return T


def _above(folder: Path, name: str) -> Path | None:
    """A file of a drive or of its day; none if neither has it."""
    return first_file((folder / name, folder.resolve().parent / name))


def _dates(listing: Path) -> np.ndarray:
    """Seconds since 1970 of rows such as ``2011-09-26 13:02:25.964389445``."""
    seconds = []
    for number, line in enumerate(read_text(listing).splitlines(), start=1):
        try:
            whole, _, fraction = line.strip().partition(".")
            date = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            seconds.append(date.timestamp() + float(f"0.{fraction or 0}"))
        except ValueError:
            raise InputError(f"{listing}, line {number}: expected a date and a time.") from None
    return np.array(seconds)


def _raw_camera(path: Path, number: int, images: ImageList) -> Calibration:
    """The rectified camera; the unrectified one if the images have another size."""
    rectified = camera_of(path, number)
    size = (images.info.width, images.info.height)
    if (rectified.width, rectified.height) in (size, (None, None)):
        return rectified
    return camera_of(path, number, rectified=False)
