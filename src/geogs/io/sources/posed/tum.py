"""TUM RGB-D: ``groundtruth.txt`` holds the poses of the colour camera at their own times."""

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation, Slerp

from geogs.errors import InputError
from geogs.io.poses import read_tum_trajectory
from geogs.io.sources.posed.files import PosedFile, PosedSet
from geogs.io.sources.tum import is_tum, open_tum
from geogs.types import Trajectory

MAX_GAP = 0.1
"""Seconds between two measured poses across which a pose is interpolated."""
MAX_BEYOND = 0.02
"""Seconds by which an image may lie before the first or after the last measured pose."""

_log = logging.getLogger(__name__)


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
            reader.name, int((~known).sum()), len(known),
        )  # fmt: skip
    files = tuple(
        PosedFile(file.path, np.linalg.inv(T), reader.calibration, None, file.timestamp)
        for file, T, is_known in zip(reader.files, T_wc, known, strict=True)
        if is_known
    )
    return PosedSet("tum", reader.name, files, scene_scale="metres")


def poses_at(
    trajectory: Trajectory, times: Float64[np.ndarray, "n"]
) -> tuple[Float64[np.ndarray, "n 4 4"], Bool[np.ndarray, "n"]]:
    """Interpolate camera-to-world poses between the measured ones, and say where that is possible.

    Positions linearly, rotations on the sphere; nothing is extrapolated: the first and last pose
    hold for ``MAX_BEYOND`` seconds outwards.
    """
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
    share = ((inside - stamps[before]) / gap)[:, None]
    poses[:, :3, 3] = (1 - share) * T[before, :3, 3] + share * T[after, :3, 3]
    poses[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(T[:, :3, :3]))(inside).as_matrix()
    return poses, known
