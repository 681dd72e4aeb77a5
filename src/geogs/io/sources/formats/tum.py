"""TUM RGB-D: ``rgb.txt`` lists the colour images with their times, ``depth.txt`` the depths.

``groundtruth.txt`` holds the poses of the colour camera at their own times.
"""

import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from geogs.documents import read_text
from geogs.errors import InputError
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.formats.image_files import ImageFile, ImageList
from geogs.io.sources.known_intrinsics import find_calibration
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet
from geogs.types import Trajectory

# Published calibrations of the colour cameras (Sturm et al., "A benchmark for the evaluation of
# RGB-D SLAM systems", IROS 2012); the images of Freiburg 3 are already undistorted.
_FREIBURG_1 = Calibration(
    517.306408, 516.469215, 318.643040, 255.313989,
    distortion=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    width=640, height=480, origin="the TUM RGB-D data set, Freiburg 1",
)  # fmt: skip
_FREIBURG_2 = Calibration(
    520.908620, 521.007327, 325.141442, 249.701764,
    distortion=(0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    width=640, height=480, origin="the TUM RGB-D data set, Freiburg 2",
)  # fmt: skip
_FREIBURG_3 = Calibration(
    535.4, 539.2, 320.1, 247.6, width=640, height=480, origin="the TUM RGB-D data set, Freiburg 3"
)  # fmt: skip

_PER_METRE = 5000.0
ASSOCIATED = 0.02
"""Seconds between an image and a depth that belong together."""
MAX_GAP = 0.1
"""Seconds between two measured poses across which a pose is interpolated."""
MAX_BEYOND = 0.02
"""Seconds by which an image may lie before the first or after the last measured pose."""

_log = logging.getLogger(__name__)


def is_tum(folder: Path) -> bool:
    """Whether ``folder`` is a sequence."""
    return (folder / "rgb.txt").is_file()


def open_tum(folder: Path) -> ImageList:
    """Read a sequence; times are those of ``rgb.txt``."""
    name = folder.resolve().name
    files = _with_depths(folder, _read_list(folder / "rgb.txt"))
    return ImageList("tum", name, files, find_calibration(folder) or known_camera(name))


def known_camera(name: str) -> Calibration | None:
    """The published calibration for a sequence called ``..freiburg1..`` or ``fr1..``."""
    for number, calibration in enumerate((_FREIBURG_1, _FREIBURG_2, _FREIBURG_3), start=1):
        if f"freiburg{number}" in name.lower() or f"fr{number}" in name.lower():
            return calibration
    return None


def _with_depths(folder: Path, files: list[ImageFile]) -> list[ImageFile]:
    """Images with the depth that is nearest in time, where one is near."""
    listing = folder / "depth.txt"
    if not listing.is_file():
        return files
    depths = _read_list(listing)
    times = np.array([depth.timestamp for depth in depths])
    found = []
    for file in files:
        n = int(np.abs(times - file.timestamp).argmin())
        is_near = abs(times[n] - file.timestamp) <= ASSOCIATED
        found.append(
            replace(file, depth=DepthFile(depths[n].path, _PER_METRE) if is_near else None)
        )
    return found


def _read_list(listing: Path) -> list[ImageFile]:
    lines, files = read_text(listing).splitlines(), []
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            time, image = float(words[0]), words[1]
            if len(words) != 2 or not math.isfinite(time):
                raise ValueError
            files.append(ImageFile(listing.parent / image, time))
        except (ValueError, IndexError):
            raise InputError(f"{listing}, line {number}: expected a time and a file.") from None
    if not files:
        raise InputError(f"{listing} lists no images.")
    return sorted(files, key=lambda file: file.timestamp)


def is_posed_tum(folder: Path) -> bool:
    """Whether ``folder`` is a sequence with its poses."""
    return is_tum(folder) and (folder / "groundtruth.txt").is_file()


def open_posed_tum(folder: Path) -> PosedSet:
    """Read a sequence; images at whose time no pose was measured are left out."""
    reader = open_tum(folder)
    trajectory = read_tum_trajectory(folder / "groundtruth.txt")
    times = np.array([file.timestamp for file in reader.files], dtype=np.float64)
    T_wc, known = poses_at(trajectory, times)
    if not known.any():
        raise InputError(
            f"No image of {folder} has a pose: the times of rgb.txt and groundtruth.txt do not "
            f"overlap; are they of one sequence?"
        )
    if not known.all():
        _log.warning(
            "%s: left out %d of %d images, at whose time no pose was measured.",
            reader.info.name, int((~known).sum()), len(known),
        )  # fmt: skip
    files = tuple(
        PosedFile(file.path, np.linalg.inv(T), reader.info.calibration, None, file.timestamp)
        for file, T, is_known in zip(reader.files, T_wc, known, strict=True)
        if is_known
    )
    return PosedSet("tum", reader.info.name, files, scene_scale="metres")


def poses_at(
    trajectory: Trajectory, times: Float64[np.ndarray, "n"]
) -> tuple[Float64[np.ndarray, "n 4 4"], Bool[np.ndarray, "n"]]:
    """Interpolate camera-to-world poses between the measured ones, and say where that is possible.

    Positions linearly, rotations on the sphere; nothing is extrapolated: the first and last pose
    hold for ``MAX_BEYOND`` seconds outwards.
    """
    from scipy.spatial.transform import Rotation, Slerp

    stamps, first = np.unique(trajectory.timestamps, return_index=True)
    T = trajectory.T_wc[first]
    inside = times.clip(stamps[0], stamps[-1])
    after = np.searchsorted(stamps, inside).clip(1, max(len(stamps) - 1, 1))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    known = np.abs(times - inside) <= MAX_BEYOND
    if len(stamps) == 1:
        return np.repeat(T, len(times), axis=0), known
    before = after - 1
    gap = stamps[after] - stamps[before]
    nearest = np.minimum(inside - stamps[before], stamps[after] - inside)
    known &= (gap <= MAX_GAP) | (nearest <= MAX_BEYOND / 10)
    fraction = ((inside - stamps[before]) / gap)[:, None]
    poses[:, :3, 3] = (1 - fraction) * T[before, :3, 3] + fraction * T[after, :3, 3]
    poses[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(T[:, :3, :3]))(inside).as_matrix()
    return poses, known
