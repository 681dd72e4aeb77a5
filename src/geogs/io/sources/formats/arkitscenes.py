"""ARKitScenes: ``lowres_wide/ID_TIME.png`` with the cameras in ``lowres_wide_intrinsics/*.pincam``.

``lowres_depth`` and ``confidence`` hold the lidar's pictures under the same names (millimetres),
``lowres_wide.traj`` the poses: time, axis times angle and translation, world to camera.
https://github.com/apple/ARKitScenes/blob/main/DATA.md
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from geogs.errors import InputError
from geogs.geometry.lie import so3_exp
from geogs.guard.documents import UNUSABLE, first_file
from geogs.io.pose_files import is_rigid, matrix_trajectory, read_rows
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.data_set_cameras import arkit_camera
from geogs.io.sources.depth_files import depth_beside
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

PICTURES = ("lowres_wide", "vga_wide", "wide")
"""Folders of images, at several sizes; the first comes with every download."""
_NAME = re.compile(r"\d+_(\d+\.\d+)")
_ASKED = 24
"""Approximate number of cameras read; they differ a little by focus."""
_MAX_GAP = 0.15
"""Longest gap between two poses for interpolation, in seconds: there are ten a second."""
_TRUTHS = ("lowres_wide.traj", "lowres_poses.traj")


def is_arkitscenes(folder: Path) -> bool:
    """Whether ``folder`` is a video of the data set."""
    described = [name for name in PICTURES if (folder / f"{name}_intrinsics").is_dir()]
    return holds_pictures(folder, (PICTURES[0], *described))


def open_arkitscenes(place: Place) -> ImageList:
    """Read the images of one size; times are those of their names."""
    found = ((_NAME.fullmatch(path.stem), path) for path in images_in(place.pictures))
    timed = sorted((float(match[1]), path) for match, path in found if match)
    if not timed:
        raise InputError(f"{place.pictures} holds no images such as 41069021_305.377.png.")
    depths = place.folder / "lowres_depth"
    trust = place.folder / "confidence"
    names = [f"{path.stem}.png" for _, path in timed]
    files = [
        ImageFile(path, time, depth_beside(depths / name, trust / name))
        for (time, path), name in zip(timed, names, strict=True)
    ]
    name = place.folder.resolve().name
    return ImageList("arkitscenes", name, files, _camera(place, [path for _, path in timed]))


def open_posed_arkitscenes(place: Place) -> PosedSet:
    """Read the images of one size with their poses."""
    file = first_file(place.folder / name for name in _TRUTHS)
    if file is None:
        raise InputError(f"{place.folder} holds no true poses: {_TRUTHS[0]} is missing.")
    return with_timed_poses(open_arkitscenes(place), read_arkitscenes_truth(file), _MAX_GAP)


def is_arkitscenes_truth(path: Path) -> bool:
    """Whether ``path`` has the name of a pose file."""
    return path.suffix == ".traj"


def read_arkitscenes_truth(path: Path) -> Trajectory:
    """Read rows ``time rx ry rz tx ty tz``, world to camera in OpenCV axes."""
    rows = read_rows(path, (7,), "time rx ry rz tx ty tz")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    T_cw = np.tile(np.eye(4), (len(rows), 1, 1))
    T_cw[:, :3, :3] = so3_exp(torch.from_numpy(rows[:, 1:4].copy())).numpy()
    T_cw[:, :3, 3] = rows[:, 4:]
    valid = np.isfinite(rows).all(axis=1) & is_rigid(T_cw)
    T_cw[~valid] = np.eye(4)
    return matrix_trajectory(path, rows[:, 0], np.linalg.inv(T_cw), valid)


def _camera(place: Place, paths: list[Path]) -> Calibration | None:
    """The median camera of images spread over the video; none where no camera is described."""
    folder = place.folder / f"{place.pictures.name}_intrinsics"
    asked = (folder / f"{p.stem}.pincam" for p in paths[:: max(1, len(paths) // _ASKED)])
    cameras = [_read(file) for file in asked if file.is_file()]
    if not cameras:
        return None
    fx, fy, cx, cy = np.median([(c.fx, c.fy, c.cx, c.cy) for c in cameras], axis=0)
    return replace(cameras[0], fx=fx, fy=fy, cx=cx, cy=cy, origin="ARKitScenes")


def _read(file: Path) -> Calibration:
    try:
        return arkit_camera(file)
    except UNUSABLE:
        raise InputError(f"{file} holds no width height fx fy cx cy; copy it again.") from None
