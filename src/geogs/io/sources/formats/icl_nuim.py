"""ICL-NUIM: ``rgb`` and ``depth`` with ``associations.txt``, which counts frames instead of time.

The poses, ``*.gt.freiburg``, have TUM's rows with the number of the frame as time. Its cameras have
a negative fy, -480: y points up, in the world as well, which makes the axes left-handed. With y
flipped in both, the images are those of a camera with fy 480.
https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.io.pose_files import FRAMES_PER_SECOND, read_tum_trajectory
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.formats.image_files import ImageFile, ImageList, depths_there, finite, listed
from geogs.io.sources.formats.timed_poses import with_timed_poses
from geogs.io.sources.formats.tum import UNIT, known_camera
from geogs.io.sources.known_intrinsics import find_calibration
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.types import Trajectory

LISTING = "associations.txt"
_TRUTH = "*.gt.freiburg"
_CAMERA = Calibration(
    481.2, 480.0, 319.5, 239.5, width=640, height=480, origin="the ICL-NUIM data set"
)
_NAMES = ("frei_png", "living_room", "livingroom", "office_room", "icl-nuim", "icl_nuim")
"""Parts of the names of folders that have the data set's camera."""
_Y_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])


def is_associated(folder: Path) -> bool:
    """Whether ``folder`` has images and depths that are listed together."""
    return (folder / LISTING).is_file() and not (folder / "rgb.txt").is_file()


def open_associated(folder: Path) -> ImageList:
    """Read a sequence; counted frames are 1/30 s apart."""
    listing = folder / LISTING
    files, fault = depths_there(listed(listing, _row, "a time and a file, twice"), listing)
    name = folder.resolve().name
    counted = all(f.timestamp == int(f.timestamp) for f in files) and _is_counted(files)
    if counted:
        files = [replace(file, timestamp=file.timestamp / FRAMES_PER_SECOND) for file in files]
    known = known_camera(name)
    if counted and (_truth_beside(folder) or any(word in name.lower() for word in _NAMES)):
        known = _CAMERA
    camera = find_calibration(folder) or known
    kind = "icl-nuim" if counted else "tum"
    return ImageList(kind, name, files, camera, depth_fault=fault)


def open_posed_associated(folder: Path) -> PosedSet:
    """Read a sequence with its poses; images without one are left out."""
    file = _truth_beside(folder)
    if file is None:
        raise InputError(f"{folder} holds no true poses ({_TRUTH}).")
    return with_timed_poses(open_associated(folder), read_icl_truth(file))


def is_icl_truth(path: Path) -> bool:
    """Whether ``path`` has the name of a pose file."""
    return path.name.endswith(".gt.freiburg")


def read_icl_truth(path: Path) -> Trajectory:
    """Read poses, right-handed; frame k is at k / 30 s."""
    counted = read_tum_trajectory(path)
    times = counted.timestamps / FRAMES_PER_SECOND
    return Trajectory(times, _Y_DOWN @ counted.T_wc @ _Y_DOWN, counted.tracked)


def _truth_beside(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob(_TRUTH))), None)


def _is_counted(files: list[ImageFile]) -> bool:
    """Whether the times are the numbers in the names of the images."""
    return all(f.path.stem == str(int(f.timestamp)) for f in files)


def _row(folder: Path, words: list[str]) -> ImageFile:
    """An image with its depth, of a row with the time and file of both, in any order."""
    one, a, other, b = words
    first, second = finite(one), finite(other)
    is_depth_first = "depth" in Path(a).parts
    time, image, depth = (second, b, a) if is_depth_first else (first, a, b)
    return ImageFile(folder / image, time, DepthFile(folder / depth, UNIT))
