"""ScanNet as exported: ``color/0.jpg, ...`` with ``depth/``, ``pose/`` and ``intrinsic/``."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import numbered, read_text
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.formats.image_files import ImageFile, ImageList, images_in
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet


def is_scannet(folder: Path) -> bool:
    """Whether ``folder`` is a scene."""
    beside = any((folder / name).is_dir() for name in ("depth", "pose", "intrinsic"))
    return (folder / "color").is_dir() and beside and bool(_images(folder))


def open_scannet(folder: Path) -> ImageList:
    """Read a scene; image k is at k / 30 s. Depth has been registered to colour."""
    depths = {k: DepthFile(path) for k, path in numbered((folder / "depth").glob("*.png"))}
    files = [ImageFile(path, k / FRAMES_PER_SECOND, depths.get(k)) for k, path in _images(folder)]
    return ImageList("scannet", folder.resolve().name, files, _calibration(folder))


def is_posed_scannet(folder: Path) -> bool:
    """Whether ``folder`` is a scene with its poses."""
    return (folder / "pose").is_dir() and (folder / "color").is_dir()


def open_posed_scannet(folder: Path) -> PosedSet:
    """Read a scene; names count as numbers, padded with zeros or not."""
    calibration = _calibration(folder)
    poses = dict(numbered((folder / "pose").glob("*.txt")))
    files = tuple(
        PosedFile(path, _read_pose(poses[k]), calibration, None, k / FRAMES_PER_SECOND)
        for k, path in _images(folder)
        if k in poses
    )
    if not files:
        raise InputError(f"{folder} holds no pose of any image (pose/0.txt and so on).")
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


def _calibration(folder: Path) -> Calibration | None:
    """The colour camera of a scene, if it is given."""
    intrinsic = folder / "intrinsic" / "intrinsic_color.txt"
    return read_calibration(intrinsic) if intrinsic.is_file() else None


def _images(folder: Path) -> list[tuple[int, Path]]:
    """The images of a scene by their numbers, padded with zeros or not."""
    return numbered(images_in(folder / "color"))
