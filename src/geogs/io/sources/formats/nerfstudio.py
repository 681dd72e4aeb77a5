"""nerfstudio, instant-ngp and Blender: ``transforms.json`` with camera-to-world matrices.

The cameras look along -z with y up (OpenGL). ``applied_transform`` and ``applied_scale`` are
the changes of the original world; they are undone, so that results fit the data set's truth.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, first_file, read_json
from geogs.io.pictures import stored_size_and_turns
from geogs.io.pose_files import FRAMES_PER_SECOND, OPENCV_FROM_OPENGL
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration_files import account_of_transforms, calibration_from_nerfstudio
from geogs.io.sources.camera_keys import has_focal_length, lens_of, of_frame
from geogs.io.sources.formats.image_files import ImageList, has_images, natural_key
from geogs.io.sources.named_files import IMAGE_FOLDERS, NamedFiles, elsewhere, unlisted
from geogs.io.sources.pose_priors import rigid_pose
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet
from geogs.io.sources.posed.stored_pictures import has_alpha, of_stored_pixels, stored_size

_FILES = (
    "transforms.json",
    "transforms_train.json",
    "nerfstudio/transforms.json",
    "iphone/nerfstudio/transforms.json",
)


def find_transforms(path: Path) -> Path | None:
    """The file of a project folder, or none; ``path`` may be the file."""
    if path.is_file():
        return path if path.suffix == ".json" else None
    return first_file(path / name for name in _FILES)


def open_nerfstudio(path: Path) -> PosedSet:
    """Read the images that ``transforms.json`` lists, in natural order of their names."""
    file = find_transforms(path)
    assert file is not None, "the file was found before"
    document = read_json(file)
    if not isinstance(document, dict) or "frames" not in document:
        raise InputError(f"{file} has no list of frames, so it is no file of nerfstudio.")
    folders = (p.name for p in file.resolve().parents if p.name not in ("nerfstudio", "iphone"))
    try:
        frames = sorted(document["frames"], key=lambda frame: natural_key(frame["file_path"]))
        names = [frame["file_path"] for frame in frames]
        found = _named_files(file)
        paths = found.find(names)
        masks = found.find([frame.get("mask_path") or "" for frame in frames])
        to_world = _undo_applied(document)
        files = tuple(
            _file(file, document, frame, to_world, path, mask, k)
            for k, (frame, path, mask) in enumerate(zip(frames, paths, masks, strict=True))
        )
        account = account_of_transforms(document, file) + elsewhere(names, paths)
        account += unlisted([*paths, *masks])
        if others := sorted(set(file.parent.glob("transforms*.json")) - {file}):
            account += Account(left=(f"{named([other.name for other in others])} beside {file}",))
    except UNUSABLE as error:
        what = f" (no entry {error})" if isinstance(error, KeyError) else ""
        raise InputError(f"{file} cannot be understood{what}; is it complete?") from None
    return PosedSet("nerfstudio", next(folders, ""), files, account=account)


def with_transforms(images: ImageList, folder: Path) -> ImageList:
    """Add the poses of ``transforms.json`` to the images beside it, where there is one.

    Raises:
        InputError: the file cannot be understood.
    """
    if find_transforms(folder) is None:
        return images
    poses = {
        file.path.resolve(): rigid_pose(T_wc, stored_size_and_turns(file.path)[1])
        for file in open_nerfstudio(folder).files
        if (T_wc := _inverse(file.T_cw)) is not None
    }
    files = [replace(file, pose=poses.get(file.path.resolve())) for file in images.files]
    if not any(file.pose is not None for file in files):
        return images
    said = images.info
    return ImageList(
        said.kind, said.name, files, said.calibration, has_poses=True, account=said.account
    )


def _inverse(T: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"] | None:
    """The inverse matrix; none where there is none."""
    is_usable = np.isfinite(T).all() and abs(np.linalg.det(T)) > 1e-9
    return np.linalg.inv(T) if is_usable else None


def _file(
    file: Path,
    document: dict[str, Any],
    frame: dict[str, Any],
    to_world: Float64[np.ndarray, "4 4"],
    path: Path | None,
    mask: Path | None,
    index: int,
) -> PosedFile:
    path = path or file.parent / frame["file_path"]
    if frame.get("mask_path"):
        mask = mask or file.parent / frame["mask_path"]
    elif has_alpha(path):
        mask = path
    entry = of_frame(document, frame)
    lens_of(entry, file)  # refuses one that is not supported
    size = stored_size(path)
    calibration = None
    if size is not None and has_focal_length(entry):
        calibration = calibration_from_nerfstudio({"w": size[0], "h": size[1], **entry}, file)
    T_cw = _pose(frame["transform_matrix"], document.get("applied_scale", 1.0), to_world)
    time = index / FRAMES_PER_SECOND
    return of_stored_pixels(PosedFile(path, T_cw, calibration, mask, time))


def _pose(
    matrix: list[list[float]], scale: float, to_world: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "4 4"]:
    rows = np.array(matrix, dtype=np.float64)
    if rows.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"transform_matrix of shape {rows.shape}")
    T_wc = np.eye(4)
    T_wc[: len(rows)] = rows
    T_wc[:3, 3] /= scale
    T_cw = _inverse(to_world @ T_wc @ OPENCV_FROM_OPENGL)
    return np.full((4, 4), np.nan) if T_cw is None else T_cw


def _undo_applied(document: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """Transform from the world of the file, its scale undone, to the original one."""
    applied = np.eye(4)
    if "applied_transform" in document:
        applied[:3] = np.array(document["applied_transform"], dtype=np.float64)[:3, :4]
    return np.linalg.inv(applied)


def _named_files(file: Path) -> NamedFiles:
    """Images relative to the JSON, in a folder of images beside it, or beside its own folder, as
    ScanNet++ has them."""
    here = file.parent
    places = [here, *(here / name for name in IMAGE_FOLDERS)]
    if not any(has_images(place) for place in places):
        places += [here.parent / name for name in IMAGE_FOLDERS]
    return NamedFiles(*places)
