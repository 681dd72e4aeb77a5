"""ScanNet as exported: ``color/<i>.jpg``, ``pose/<i>.txt`` and ``intrinsic/``."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.documents import read_text
from geogs.errors import InputError
from geogs.io.poses import FRAMES_PER_SECOND
from geogs.io.sources.posed.files import PosedFile, PosedSet
from geogs.io.sources.scannet import numbered_images, scannet_calibration


def is_scannet(folder: Path) -> bool:
    """Whether ``folder`` is a scene with its poses."""
    return (folder / "pose").is_dir() and (folder / "color").is_dir()


def open_scannet(folder: Path) -> PosedSet:
    """Read a scene; names count as numbers, padded with zeros or not."""
    calibration = scannet_calibration(folder)
    poses = {
        int(path.stem): path for path in (folder / "pose").glob("*.txt") if path.stem.isdecimal()
    }
    files = tuple(
        PosedFile(path, _read_pose(poses[k]), calibration, None, k / FRAMES_PER_SECOND)
        for k, path in numbered_images(folder)
        if k in poses
    )
    return PosedSet("scannet", folder.resolve().name, files, scene_scale="metres")


def _read_pose(path: Path) -> Float64[np.ndarray, "4 4"]:
    """World to camera; NaN where tracking was lost (the file then holds -inf)."""
    try:
        T_wc = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except ValueError:
        raise InputError(f"{path} should hold a 4x4 matrix; copy it again.") from None
    if not np.isfinite(T_wc).all() or abs(np.linalg.det(T_wc)) < 1e-9:
        return np.full((4, 4), np.nan)
    return np.linalg.inv(T_wc)
