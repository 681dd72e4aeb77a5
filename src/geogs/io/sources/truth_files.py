"""Ground-truth pose files of any data set."""

from collections.abc import Callable
from pathlib import Path

from geogs.io.pose_files import FRAMES_PER_SECOND, columns_of, pose_file, read_poses
from geogs.io.sources.formats import arkitscenes, asl, icl_nuim, kitti, tartanair
from geogs.types import Trajectory

OWN_TIMES = "its own times"
"""Clock of poses with times."""
_COUNTED = f"row k at k / {FRAMES_PER_SECOND:g} s, as it has no times"
_FILES: tuple[tuple[Callable[[Path], bool], Callable[[Path], Trajectory], str], ...] = (
    (asl.is_asl_truth, asl.read_asl_truth, OWN_TIMES),
    (kitti.is_kitti_truth, kitti.read_kitti_truth, "times.txt of the sequence"),
    (tartanair.is_tartanair_truth, tartanair.read_tartanair_truth, _COUNTED),
    (arkitscenes.is_arkitscenes_truth, arkitscenes.read_arkitscenes_truth, OWN_TIMES),
    (icl_nuim.is_icl_truth, icl_nuim.read_icl_truth, _COUNTED),
)
"""Formats that need more than their rows: axes, times, or the pose of the camera in a body; with
their clocks."""


def read_truth(path: Path) -> tuple[Trajectory, str]:
    """Read true poses of a camera from a file, or from a folder with one; and their clock, in
    words.

    Raises:
        InputError: there are none.
    """
    for is_such, read, clock in _FILES:
        if path.is_file() and is_such(path):
            return read(path), clock
    trajectory = read_poses(path)
    file = pose_file(path)
    has_times = file is not None and columns_of(file) == 8
    where = "" if file in (None, path) else f" ({file.name})"
    return trajectory, (OWN_TIMES if has_times else _COUNTED) + where
