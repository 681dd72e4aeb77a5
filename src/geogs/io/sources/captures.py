"""Images with poses that an app exported: Polycam's folder, nerfstudio's ``transforms.json``."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.documents import UNUSABLE, read_json
from geogs.errors import InputError
from geogs.io.poses import FRAMES_PER_SECOND
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.images import ImageFile, ImageList, natural_key
from geogs.io.sources.pose_priors import OPENCV_FROM_OPENGL, measured_pose, rigid
from geogs.io.sources.posed.nerfstudio import find_transforms, open_nerfstudio

_PER_METRE = 1000.0
_FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Where an export of Polycam's raw data has cameras and images; none if it is no such."""
    base = folder / "keyframes"
    for cameras, images in _FOLDERS:
        if (base / cameras).is_dir() and (base / images).is_dir():
            return base / cameras, base / images
    return None


def open_polycam(folder: Path) -> ImageList:
    """Read the keyframes of an export; they are taken to be a thirtieth of a second apart.

    Raises:
        InputError: there are none, or a camera cannot be understood.
    """
    places = polycam_folders(folder)
    if places is None:
        raise InputError(f"{folder} is no export of Polycam's raw data.")
    cameras, images = places
    files, lenses = [], []
    for n, path in enumerate(sorted(cameras.glob("*.json"), key=lambda p: natural_key(p.name))):
        image = images / f"{path.stem}.jpg"
        if not image.is_file():
            continue
        document = read_json(path)
        try:
            rows = [[document[f"t_{i}{j}"] for j in range(4)] for i in range(3)]
            T_wc = np.array([*rows, [0, 0, 0, 1]], dtype=np.float64)
            lens = [float(document[k]) for k in ("fx", "fy", "cx", "cy")]
            lens += [float(document["width"]), float(document["height"])]
            if not all(map(math.isfinite, lens)):
                raise ValueError
            lenses.append(lens)
        except UNUSABLE:
            raise InputError(f"{path} holds no camera of Polycam; export it again.") from None
        pose = rigid(T_wc @ OPENCV_FROM_OPENGL)
        depth = folder / "keyframes" / "depth" / f"{path.stem}.png"
        files.append(
            ImageFile(
                image, n / FRAMES_PER_SECOND,
                DepthFile(depth, _PER_METRE) if depth.is_file() else None,
                None if pose is None else measured_pose(pose),
            )
        )  # fmt: skip
    if not files:
        raise InputError(f"{folder} holds no images with cameras in keyframes/; export it again.")
    fx, fy, cx, cy, width, height = np.median(np.array(lenses), axis=0)
    calibration = Calibration(
        fx, fy, cx, cy, width=int(width), height=int(height), origin="Polycam"
    )
    name = folder.resolve().name
    return ImageList("polycam", name, files, calibration, "Polycam", is_capture=True)


def with_transforms(images: ImageList, folder: Path) -> ImageList:
    """Images with the poses that ``transforms.json`` beside them says, where there is one.

    Raises:
        InputError: the file cannot be understood.
    """
    if find_transforms(folder) is None:
        return images
    posed = open_nerfstudio(folder)
    poses = {f.path.resolve(): rigid(np.linalg.inv(_finite(f.T_cw))) for f in posed.files}
    files = []
    for file in images.files:
        T_wc = poses.get(file.path.resolve())
        files.append(replace(file, pose=None if T_wc is None else measured_pose(T_wc)))
    if not any(file.pose is not None for file in files):
        return images
    return ImageList(
        images.kind, images.name, files, images.calibration, "the transforms.json beside them"
    )


def _finite(T: np.ndarray) -> np.ndarray:
    """The matrix; one that can be inverted and is no pose where it cannot."""
    is_usable = np.isfinite(T).all() and abs(np.linalg.det(T)) > 1e-9
    return T if is_usable else np.diag([2.0, 2.0, 2.0, 1.0])
