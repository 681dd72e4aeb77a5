"""Replica: ``traj.txt`` holds the pose of image k in line k, camera to world."""

from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.io.poses import FRAMES_PER_SECOND, read_replica_trajectory
from geogs.io.sources.posed.files import PosedFile, PosedSet
from geogs.io.sources.replica import is_replica, open_replica


def is_posed_replica(folder: Path) -> bool:
    """Whether ``folder`` is a Replica scene with its poses."""
    return is_replica(folder) and (_scene(folder) / "traj.txt").is_file()


def open_posed_replica(folder: Path) -> PosedSet:
    """Read a scene; images without a valid pose are left out."""
    scene = _scene(folder)
    reader = open_replica(folder)
    trajectory = read_replica_trajectory(scene / "traj.txt")
    frames = np.rint(trajectory.timestamps * FRAMES_PER_SECOND).astype(int)
    T_cw = {int(k): np.linalg.inv(T) for k, T in zip(frames, trajectory.T_wc, strict=True)}
    files = []
    for file in reader.files:
        number = round(file.timestamp * FRAMES_PER_SECOND)
        if number in T_cw:
            mask = file.path.with_name(f"mask{number:06d}.png")
            files.append(
                PosedFile(
                    file.path,
                    T_cw[number],
                    reader.calibration,
                    mask if mask.is_file() else None,
                    file.timestamp,
                )
            )
    if not files:
        raise InputError(f"{scene / 'traj.txt'} holds no pose for any image of {scene}.")
    return PosedSet("replica", reader.name, tuple(files), scene_scale="metres")


def _scene(folder: Path) -> Path:
    return folder.parent if folder.name == "results" else folder
