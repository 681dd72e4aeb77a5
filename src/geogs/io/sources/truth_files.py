"""Ground-truth pose files of any data set."""

from collections.abc import Callable
from pathlib import Path

from geogs.io.pose_files import read_poses
from geogs.io.sources.formats import arkitscenes, asl, icl_nuim, kitti, tartanair
from geogs.types import Trajectory

_FILES: tuple[tuple[Callable[[Path], bool], Callable[[Path], Trajectory]], ...] = (
    (asl.is_asl_truth, asl.read_asl_truth),
    (kitti.is_kitti_truth, kitti.read_kitti_truth),
    (tartanair.is_tartanair_truth, tartanair.read_tartanair_truth),
    (arkitscenes.is_arkitscenes_truth, arkitscenes.read_arkitscenes_truth),
    (icl_nuim.is_icl_truth, icl_nuim.read_icl_truth),
)
"""Formats that need more than their rows: axes, times, or the pose of the camera in a body."""


def read_truth(path: Path) -> Trajectory:
    """Read true poses of a camera from a file, or from a folder with one.

    Raises:
        InputError: there are none.
    """
    for is_such, read in _FILES:
        if path.is_file() and is_such(path):
            return read(path)
    return read_poses(path)
