"""nerfstudio, instant-ngp and Blender: ``transforms.json`` with camera-to-world matrices.

The cameras look along -z with y up (OpenGL). ``applied_transform`` and ``applied_scale`` are
the changes of the original world; they are undone, so that results fit the data set's truth.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.documents import UNUSABLE, first_file, read_json
from geogs.errors import InputError
from geogs.io.pose_files import FRAMES_PER_SECOND, OPENCV_FROM_OPENGL
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import calibration_from_nerfstudio
from geogs.io.sources.formats.image_files import ImageList, natural_key
from geogs.io.sources.pose_priors import rigid_pose
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet
from geogs.io.sources.posed.stored_pictures import has_alpha, stored_size

_FILES = (
    "transforms.json", "transforms_train.json", "nerfstudio/transforms.json",
    "iphone/nerfstudio/transforms.json",
)  # fmt: skip
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")


def find_transforms(path: Path) -> Path | None:
    """The file of a project folder, or none; ``path`` may be the file."""
    if path.is_file():
        return path if path.suffix == ".json" else None
    return first_file(path / name for name in _FILES)


def open_nerfstudio(path: Path) -> PosedSet:
    """Read the images that ``transforms.json`` lists, in natural order of their names."""
    file = find_transforms(path)
    assert file is not None, "the file was found before"
    document = _read(file)
    try:
        frames = sorted(document["frames"], key=lambda frame: natural_key(frame["file_path"]))
        to_world = _undo_applied(document)
        files = tuple(_file(file, document, frame, to_world, k) for k, frame in enumerate(frames))
    except UNUSABLE as error:
        what = f" (no entry {error})" if isinstance(error, KeyError) else ""
        raise InputError(f"{file} cannot be understood{what}; is it complete?") from None
    return PosedSet("nerfstudio", _name(file), files)


def with_transforms(images: ImageList, folder: Path) -> ImageList:
    """Add the poses of ``transforms.json`` to the images beside it, where there is one.

    Raises:
        InputError: the file cannot be understood.
    """
    if find_transforms(folder) is None:
        return images
    posed = open_nerfstudio(folder)
    poses = {f.path.resolve(): rigid_pose(np.linalg.inv(_finite(f.T_cw))) for f in posed.files}
    files = [replace(file, pose=poses.get(file.path.resolve())) for file in images.files]
    if not any(file.pose is not None for file in files):
        return images
    said = images.info
    return ImageList(said.kind, said.name, files, said.calibration, has_poses=True)


def _finite(T: np.ndarray) -> np.ndarray:
    """The matrix; if it cannot be inverted, an invertible one that is no pose."""
    is_usable = np.isfinite(T).all() and abs(np.linalg.det(T)) > 1e-9
    return T if is_usable else np.diag([2.0, 2.0, 2.0, 1.0])


def _read(file: Path) -> dict[str, Any]:
    document = read_json(file)
    if not isinstance(document, dict) or "frames" not in document:
        raise InputError(f"{file} has no list of frames, so it is no file of nerfstudio.")
    return document


def _name(file: Path) -> str:
    folder = file.resolve().parent
    while folder.name in ("nerfstudio", "iphone") and folder.parent != folder:
        folder = folder.parent
    return folder.name


def _file(
    file: Path,
    document: dict[str, Any],
    frame: dict[str, Any],
    to_world: Float64[np.ndarray, "4 4"],
    index: int,
) -> PosedFile:
    path = _image(file, frame["file_path"])
    mask = frame.get("mask_path")
    if mask is not None:
        mask = _image(file, mask)
    elif has_alpha(path):
        mask = path
    calibration = _calibration({**document, **frame}, path, file)
    T_cw = _pose(frame["transform_matrix"], document.get("applied_scale", 1.0), to_world)
    return PosedFile(path, T_cw, calibration, mask, index / FRAMES_PER_SECOND)


def _pose(
    matrix: list[list[float]], scale: float, to_world: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "4 4"]:
    rows = np.array(matrix, dtype=np.float64)
    if rows.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"transform_matrix of shape {rows.shape}")
    if not np.isfinite(rows).all():
        return np.full((4, 4), np.nan)
    T_wc = np.eye(4)
    T_wc[:3] = rows[:3]
    T_wc[:3, 3] /= scale
    if abs(np.linalg.det(T_wc[:3, :3])) < 1e-9:
        return np.zeros((4, 4))
    return np.linalg.inv(to_world @ T_wc @ OPENCV_FROM_OPENGL)


def _undo_applied(document: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """Transform from the world of the file, its scale undone, to the original one."""
    applied = np.eye(4)
    if "applied_transform" in document:
        applied[:3] = np.array(document["applied_transform"], dtype=np.float64)[:3, :4]
    return np.linalg.inv(applied)


def _calibration(entry: dict[str, Any], image: Path, file: Path) -> Calibration | None:
    """The camera of a frame; ``camera_angle_x`` (Blender) is its field of view across, radians."""
    if "fl_x" not in entry and "camera_angle_x" not in entry:
        return None
    size = stored_size(image)
    if size is None:
        return None
    entry = {"w": size[0], "h": size[1], **entry}
    if "fl_x" not in entry:
        entry["fl_x"] = entry["w"] / 2 / math.tan(entry["camera_angle_x"] / 2)
    return calibration_from_nerfstudio({"cx": entry["w"] / 2, "cy": entry["h"] / 2, **entry}, file)


def _image(file: Path, name: str) -> Path:
    """The file of an image: relative to the JSON, with or without its suffix.

    ScanNet++ lists bare names of images that lie in a folder beside that of the JSON.
    """
    beside = file.parent.parent
    bases = (file.parent, file.parent / "images", beside / "rgb", beside / "images")
    found = first_file(base / f"{name}{suffix}" for base in bases for suffix in _SUFFIXES)
    return found or file.parent / name
