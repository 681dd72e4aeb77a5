"""TUM RGB-D: ``rgb.txt`` lists the colour images with their times, ``depth.txt`` the depths.

``groundtruth.txt`` holds the poses of the colour camera at their own times. Bonn's dynamic data set
and ETH3D's SLAM sequences (with ``calibration.txt``) have the same layout.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthFile, DepthUnit
from geogs.io.sources.formats.image_files import ImageFile, ImageList, depths_there, finite, listed
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.known_intrinsics import find_calibration
from geogs.io.sources.posed.posed_set import PosedSet

# Published calibrations of the colour cameras (Sturm et al., "A benchmark for the evaluation of
# RGB-D SLAM systems", IROS 2012); the images of Freiburg 3 are already undistorted.
_FREIBURG_1 = Calibration(
    517.306408,
    516.469215,
    318.643040,
    255.313989,
    distortion=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    width=640,
    height=480,
    origin="the TUM RGB-D data set, Freiburg 1",
)
_FREIBURG_2 = Calibration(
    520.908620,
    521.007327,
    325.141442,
    249.701764,
    distortion=(0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    width=640,
    height=480,
    origin="the TUM RGB-D data set, Freiburg 2",
)
_FREIBURG_3 = Calibration(
    535.4, 539.2, 320.1, 247.6, width=640, height=480, origin="the TUM RGB-D data set, Freiburg 3"
)

_BONN = Calibration(
    542.822841,
    542.576870,
    315.593520,
    237.756098,
    distortion=(0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    width=640,
    height=480,
    origin="the Bonn RGB-D dynamic data set",
)

UNIT = DepthUnit(5000.0, "TUM's")
"""Unit of depth images where no file beside them states another."""
ASSOCIATED = 0.02
"""Largest time difference between an image and its depth, in seconds."""


def is_tum(folder: Path) -> bool:
    """Whether ``folder`` is a sequence."""
    return (folder / "rgb.txt").is_file()


def open_tum(folder: Path) -> ImageList:
    """Read a sequence; times are those of ``rgb.txt``."""
    name = folder.resolve().name
    files, fault = _with_depths(folder, _read_list(folder / "rgb.txt"))
    camera = find_calibration(folder) or known_camera(name)
    return ImageList("tum", name, files, camera, depth_fault=fault)


def known_camera(name: str) -> Calibration | None:
    """The published calibration for a sequence called ``..freiburg1..``, ``fr1..`` or
    ``rgbd_bonn..``."""
    for number, calibration in enumerate((_FREIBURG_1, _FREIBURG_2, _FREIBURG_3), start=1):
        if f"freiburg{number}" in name.lower() or f"fr{number}" in name.lower():
            return calibration
    return _BONN if name.lower().startswith("rgbd_bonn") else None


def _with_depths(folder: Path, files: list[ImageFile]) -> tuple[list[ImageFile], str]:
    """Images with the depth nearest in time, where one is near; a reason if none has any."""
    listing = folder / "depth.txt"
    if not listing.is_file():
        return files, ""
    depths = _read_list(listing)
    times = np.array([depth.timestamp for depth in depths])
    found = []
    for file in files:
        n = int(np.abs(times - file.timestamp).argmin())
        is_near = abs(times[n] - file.timestamp) <= ASSOCIATED
        found.append(replace(file, depth=DepthFile(depths[n].path, UNIT) if is_near else None))
    if not any(file.depth is not None for file in found):
        return found, f"no time in {listing} is near that of an image"
    return depths_there(found, listing)


def _read_list(listing: Path) -> list[ImageFile]:
    return listed(listing, _row, "a time and a file")


def _row(folder: Path, words: list[str]) -> ImageFile:
    time, name = words
    return ImageFile(folder / name, finite(time))


def is_posed_tum(folder: Path) -> bool:
    """Whether ``folder`` is a sequence with its poses."""
    return is_tum(folder) and (folder / "groundtruth.txt").is_file()


def open_posed_tum(folder: Path) -> PosedSet:
    """Read a sequence; images at whose time no pose was measured are left out."""
    return with_timed_poses(open_tum(folder), read_tum_trajectory(folder / "groundtruth.txt"))
