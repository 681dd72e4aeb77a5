"""MVSNet and BlendedMVS: a file of each camera in ``cams/`` beside the images.

``extrinsic`` is world to camera, 4 x 4; ``intrinsic`` is 3 x 3, its first pixel's centre at
(0.5, 0.5), as in COLMAP, of which most such files are made. https://github.com/YoYo000/MVSNet
"""

import re
from pathlib import Path

import numpy as np

from geogs.guard.documents import read_text
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.image_files import has_images
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    check_neglected,
    find_file,
    posed_set,
    understood,
)
from geogs.io.sources.posed.posed_set import PosedSet

_FOLDERS = ("blended_images", "images", "image", "rgb")
_SUFFIX = "_cam.txt"
_SCALES = (1, 2, 4, 8, 0.5, 0.25)
"""Sizes of the images by that for which intrinsics are: networks are trained on smaller depths."""
_CENTRED = 0.15
"""Largest offset of a principal point from the middle, as a fraction of the image, that shows for
which size the intrinsics are."""


def find_mvsnet(path: Path) -> Path | None:
    """The first camera in a folder of a scene, or none; ``path`` may be one."""
    return find_file(path, (f"cams/*{_SUFFIX}", f"*{_SUFFIX}"), b"extrinsic", b"intrinsic")


def open_mvsnet(file: Path) -> PosedSet:
    """Read the images of all cameras in the folder of one.

    Raises:
        InputError: a file cannot be understood.
    """
    place = file.absolute().parent
    scene = place.parent if place.name == "cams" else place
    files = sorted(place.glob(f"*{_SUFFIX}"))
    views = [_view(path) for path in files]
    folders = [scene / name for name in _FOLDERS if has_images(scene / name)]
    unused = [f"{folder}, as {folders[0]} is there" for folder in folders[1:]]
    account = Account(left=tuple(unused))
    return posed_set("mvsnet", scene / place.name, views, (), account, *(folders[:1] or [scene]))


def _view(path: Path) -> View:
    with understood(path, "copy it again"):
        words = re.split(r"extrinsic|intrinsic", read_text(path))[1:3]
        extrinsic, intrinsic = (np.array(part.split(), dtype=np.float64) for part in words)
        K = intrinsic[:9].reshape(3, 3)
        return View(path.name.removesuffix(_SUFFIX), extrinsic.reshape(4, 4), _camera(K, path))


def _camera(K: np.ndarray, path: Path) -> SizedCamera:
    def sized(width: int, height: int) -> Calibration:
        size = np.array([width, height])
        offsets = [np.abs(scale * K[:2, 2] / size - 0.5).max() for scale in _SCALES]
        scale = _SCALES[int(np.argmin(offsets))] if min(offsets) < _CENTRED else 1
        account = check_neglected({"skew": scale * K[0, 1] * height / 2 / K[1, 1]}, path)
        said = f"intrinsics in {path.parent}, times {scale:g} as their principal point shows"
        account += Account(used=(said,) if scale != 1 else ())
        fx, fy, cx, cy = (scale * float(K[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
        origin = str(path.parent)
        return Calibration(
            fx, fy, cx - 0.5, cy - 0.5, (), width, height, origin=origin, account=account
        )

    return sized
