"""Bundler's ``bundle.out`` with its list of images, and VisualSFM's ``.nvm``.

Bundler's cameras look along -z with y up; the origin is the middle of the image, (w - 1) / 2,
(h - 1) / 2 in pixels whose centres are integers. https://www.cs.cornell.edu/~snavely/bundler
VisualSFM's are in OpenCV axes, with the rotation world to camera and the camera's place; its
radial term r removes distortion: x = m (1 + r m^2). http://ccwu.me/vsfm/doc.html#nvm
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import first_file, read_text
from geogs.io.pose_files import OPENCV_FROM_OPENGL
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.colmap import pose_from
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    brown_lens,
    check_neglected,
    find_file,
    pose,
    pose_at,
    posed_set,
    understood,
)
from geogs.io.sources.posed.posed_set import PosedSet

_BUNDLES = ("bundle.out", "bundle/bundle.out", "*.out", "bundle*.txt")
_LISTS = ("list.txt", "bundle.out.list.txt", "image_list.txt", "images.lst", "list.lst")

_FOCAL = re.compile(r"\s+0\s+[\d.eE+-]+$")
"""Word that follows the name of an image whose focal length is known from EXIF."""


def find_bundler(path: Path) -> Path | None:
    """The bundle of a folder, or none; ``path`` may be the file."""
    return find_file(path, _BUNDLES, b"# bundle file v0.")


def open_bundler(file: Path) -> PosedSet:
    """Read the cameras, of which those of focal length 0 have no pose.

    Raises:
        InputError: the list of images is missing, or a file cannot be understood.
    """
    beside = [file.with_suffix(suffix) for suffix in (".lst", ".list.txt", ".txt")]
    places = [place / name for place in (file.parent, file.parent.parent) for name in _LISTS]
    listing = first_file(place for place in (*beside, *places) if place != file)
    if listing is None:
        raise InputError(
            f"{file} names no images; put the list of them beside it, as {file.parent / _LISTS[0]}."
        )
    with understood(file, f"if {listing} is its list of images, export both again"):
        lines = read_text(listing).splitlines()
        names = [_FOCAL.sub("", line.strip()) for line in lines if line.strip()]
        words = [line for line in read_text(file).splitlines() if not line.startswith("#")]
        count = int(words[0].split()[0])
        numbers = np.array(" ".join(words[1 : 1 + 5 * count]).split(), dtype=np.float64)
        cameras = numbers.reshape(count, 15)
        pairs = list(zip(names, cameras, strict=True))
        views = [View(name, _gl_pose(row), _camera(row[:3], file)) for name, row in pairs if row[0]]
        without = [name for name, row in pairs if not row[0]]
    return posed_set("bundler", file, views, without)


def _gl_pose(row: Float64[np.ndarray, "15"]) -> Float64[np.ndarray, "4 4"]:
    """World to camera of f, k1, k2, rotation and translation."""
    T: np.ndarray = OPENCV_FROM_OPENGL @ pose(row[3:12].reshape(3, 3), row[12:])
    return T


def _camera(lens: Float64[np.ndarray, "3"], file: Path) -> SizedCamera:
    f, k1, k2 = (float(number) for number in lens)

    def sized(width: int, height: int) -> Calibration:
        centre = (width - 1) / 2, (height - 1) / 2
        size = width, height
        return brown_lens((f, f), centre, (k1, k2, 0.0, 0.0), (0.0, 0.0), size, str(file))

    return sized


def find_nvm(path: Path) -> Path | None:
    """The model of a folder, or none; ``path`` may be the file."""
    return find_file(path, ("*.nvm", "*/*.nvm"), b"nvm_v3")


def open_nvm(file: Path) -> PosedSet:
    """Read the first model of a file, the largest.

    Raises:
        InputError: it cannot be understood.
    """
    lines = [line for line in read_text(file).splitlines() if line.strip()]
    with understood(file):
        fixed = [float(word) for word in lines[0].split("FixedK")[1:] for word in word.split()]
        count = int(lines[1])
        views = [_nvm_view(line, fixed, file) for line in lines[2 : 2 + count]]
    return posed_set("visualsfm", file, views)


def _nvm_view(line: str, fixed: Sequence[float], file: Path) -> View:
    name, *words = line.rsplit(maxsplit=10)
    f, *numbers = (float(word) for word in words)
    rotation = pose_from(numbers[:4], (0.0, 0.0, 0.0))[:3, :3]
    centre = np.array(numbers[4:7])
    r = numbers[7]

    def sized(width: int, height: int) -> Calibration:
        fx, cx, fy, cy = fixed or (f, width / 2, f, height / 2)
        # The series of the inverse; the first neglected term is 55 r^4 x^9.
        corner = np.hypot(width, height) / 2 / f
        account = check_neglected({"r": 55 * r**4 * corner**9 * f}, file)
        radial = (-r, 3 * r**2, -12 * r**3, 0.0)
        size = width, height
        middle = cx - 0.5, cy - 0.5
        return brown_lens((fx, fy), middle, radial, (0.0, 0.0), size, str(file), account)

    return View(name.strip().replace('"', " "), pose_at(rotation, centre), sized)
