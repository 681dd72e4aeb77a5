"""Raw data that Polycam exported: keyframes with their cameras, poses and depths."""

from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, read_json
from geogs.io.pose_files import FRAMES_PER_SECOND, OPENCV_FROM_OPENGL
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import depth_beside
from geogs.io.sources.formats.image_files import ImageFile, ImageList, finite, natural_key
from geogs.io.sources.pose_priors import rigid_pose

_DIGITS, _LEAST_GAP = 18, 1e-3
"""Most digits of a time in microseconds, and least median gap of keyframes in seconds."""
_LENS = ("fx", "fy", "cx", "cy", "width", "height")
_FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Folders of cameras and images of a Polycam raw-data export; none if it is not one."""
    base = folder / "keyframes"
    for cameras, images in _FOLDERS:
        if (base / cameras).is_dir() and (base / images).is_dir():
            return base / cameras, base / images
    return None


def open_polycam(folder: Path) -> ImageList:
    """Read the keyframes of an export, whose names are their times in microseconds.

    Where they cannot be times, keyframes are assumed to be 1/30 s apart.

    Raises:
        InputError: there are none, or a camera cannot be understood.
    """
    places = polycam_folders(folder)
    assert places is not None, "the folder is an export"
    cameras, images = places
    files = []
    lenses = []
    paths = sorted(cameras.glob("*.json"), key=lambda p: natural_key(p.name))
    times = _times([path.stem for path in paths])
    for path in paths:
        image = images / f"{path.stem}.jpg"
        if not image.is_file():
            continue
        document = read_json(path)
        try:
            rows = [[document[f"t_{i}{j}"] for j in range(4)] for i in range(3)]
            T_wc = np.array([*rows, [0, 0, 0, 1]], dtype=np.float64)
            lenses.append([finite(document[name]) for name in _LENS])
        except UNUSABLE:
            raise InputError(f"{path} holds no camera of Polycam; export it again.") from None
        name = f"{path.stem}.png"  # confidences 0, 127 and 255 are low, medium and high
        depth = depth_beside(cameras.parent / "depth" / name, cameras.parent / "confidence" / name)
        pose = rigid_pose(T_wc @ OPENCV_FROM_OPENGL)
        files.append(ImageFile(image, times[path.stem], depth, pose))
    if not files:
        raise InputError(f"{folder} holds no images with cameras in keyframes/; export it again.")
    fx, fy, cx, cy, width, height = np.median(np.array(lenses), axis=0)
    calibration = Calibration(
        fx, fy, cx, cy, width=int(width), height=int(height), origin="Polycam"
    )
    name = folder.resolve().name
    return ImageList("polycam", name, files, calibration, has_poses=True, is_capture=True)


def _times(names: list[str]) -> dict[str, float]:
    """Time of each keyframe since the first, in seconds; names are in order."""
    evenly = {name: n / FRAMES_PER_SECOND for n, name in enumerate(names)}
    if not all(name.isdecimal() and len(name) <= _DIGITS for name in names):
        return evenly
    seconds = {name: (int(name) - int(names[0])) * 1e-6 for name in names}
    gaps = np.diff([*seconds.values()])
    return seconds if len(gaps) and np.median(gaps) > _LEAST_GAP else evenly
