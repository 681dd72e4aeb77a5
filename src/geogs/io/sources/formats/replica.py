"""Replica as rendered for iMAP: ``results/frame000000.jpg, depth000000.png, ...``.

``cam_params.json`` has the camera, and how many units of the depths make a metre; ``traj.txt`` the
pose of image k in line k, camera to world.
"""

import re
from collections.abc import Container
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import first_file, numbered
from geogs.io.pose_files import FRAMES_PER_SECOND, read_replica_trajectory
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.depth_files import DepthFile, DepthUnit
from geogs.io.sources.depth_unit import camera_scale
from geogs.io.sources.formats.image_files import ImageFile, ImageList, file_names
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet

_NAME = re.compile(r"frame(\d+)\.(jpg|jpeg|png)", re.IGNORECASE)
_CAMERA = Calibration(
    600.0, 600.0, 599.5, 339.5, width=1200, height=680, origin="the Replica data set"
)
_UNIT = DepthUnit(6553.5, "Replica's")


def is_replica(folder: Path) -> bool:
    """Whether ``folder`` is a scene, or the ``results`` folder of one."""
    results = _results(folder)
    return results.is_dir() and any(_NAME.fullmatch(path.name) for path in results.iterdir())


def open_replica(folder: Path) -> ImageList:
    """Read a scene; frame k is at k / 30 s, which matches line k of ``traj.txt``."""
    results = _results(folder)
    scene = results.parent.resolve()
    file = _parameters(scene)
    unit = (file and camera_scale(file)) or _UNIT
    there = {*file_names(results)}
    files = [
        ImageFile(path, k / FRAMES_PER_SECOND, _depth(path, k, unit, there))
        for k, path in numbered(results.iterdir(), _NAME)
    ]
    reader = ImageList("replica", scene.name, files, None)
    info = reader.info
    calibration = _find_calibration(scene, info.width, info.height)
    reader.info = replace(info, calibration=calibration)
    return reader


def _depth(image: Path, number: int, unit: DepthUnit, there: Container[str]) -> DepthFile | None:
    digits = len(image.stem) - len("frame")
    path = image.with_name(f"depth{number:0{digits}d}.png")
    return DepthFile(path, unit) if path.name in there else None


def _parameters(scene: Path) -> Path | None:
    """The file of the camera, beside or above the scene."""
    return first_file((scene / "cam_params.json", scene.parent / "cam_params.json"))


def open_posed_replica(folder: Path) -> PosedSet:
    """Read a scene; images without a valid pose are left out."""
    poses = _results(folder).parent / "traj.txt"
    reader = open_replica(folder)
    trajectory = read_replica_trajectory(poses)
    frames = np.rint(trajectory.timestamps * FRAMES_PER_SECOND).astype(int)
    T_cw = {int(k): np.linalg.inv(T) for k, T in zip(frames, trajectory.T_wc, strict=True)}
    files = []
    for file in reader.files:
        number = round(file.timestamp * FRAMES_PER_SECOND)
        if number not in T_cw:
            continue
        path = file.path.with_name(f"mask{number:06d}.png")
        mask = path if path.is_file() else None
        pose = T_cw[number]
        files.append(PosedFile(file.path, pose, reader.info.calibration, mask, file.timestamp))
    if not files:
        raise InputError(f"{poses} holds no pose for any image of {poses.parent}.")
    return PosedSet("replica", reader.info.name, tuple(files), scene_scale="metres")


def _results(folder: Path) -> Path:
    return folder if folder.name == "results" else folder / "results"


def _find_calibration(scene: Path, width: int, height: int) -> Calibration | None:
    file = _parameters(scene)
    if file is not None:
        return read_calibration(file)
    return _CAMERA if (width, height) == (1200, 680) else None
