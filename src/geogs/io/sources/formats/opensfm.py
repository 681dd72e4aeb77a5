"""OpenSfM and OpenDroneMap: ``reconstruction.json`` beside or above ``images/``.

Shots have rotation vectors and translations, world to camera. Focal lengths and principal points
are in units of the longer side of the image, from its middle, which is (w - 1) / 2, (h - 1) / 2 in
pixels whose centres are integers. https://opensfm.org/docs/geometry.html
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geogs.camera.distortion import LensModel
from geogs.errors import InputError
from geogs.guard.documents import LARGEST_TEXT, read_json
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    find_file,
    pose,
    posed_set,
    refused,
    understood,
)
from geogs.io.sources.posed.posed_set import PosedSet

_FILES = ("reconstruction.json", "opensfm/reconstruction.json", "undistorted/reconstruction.json")
_LENSES: dict[str, tuple[LensModel, str]] = {
    "perspective": ("polynomial", "k1 k2 0 0"),
    "simple_radial": ("polynomial", "k1 0 0 0"),
    "radial": ("polynomial", "k1 k2 0 0"),
    "brown": ("polynomial", "k1 k2 p1 p2 k3"),
    "fisheye": ("fisheye", "k1 k2 0 0"),
    "fisheye_opencv": ("fisheye", "k1 k2 k3 k4"),
}
"""Lens of each type of projection, and the keys of its coefficients in OpenCV's order."""


def find_opensfm(path: Path) -> Path | None:
    """The file of a project folder, or none; ``path`` may be the file."""
    return find_file(path, _FILES, b'"projection_type"', b'"cameras"')


def open_opensfm(file: Path) -> PosedSet:
    """Read the reconstruction with most images.

    Raises:
        InputError: there is none, or the file cannot be understood.
    """
    document = read_json(file, LARGEST_TEXT)
    with understood(file):
        parts = sorted(document, key=lambda part: len(part["shots"]), reverse=True)
        if not parts:
            raise InputError(f"{file} holds no reconstruction; align the images again.")
        cameras = {name: _camera(entry, file) for name, entry in parts[0]["cameras"].items()}
        views = [_view(name, shot, cameras) for name, shot in parts[0]["shots"].items()]
        panoramas = list(parts[0].get("pano_shots", ()))
    others = [f"one of {len(part['shots'])} images" for part in parts[1:]]
    left = [f"smaller reconstructions of {file}: {named(others)}"] if others else []
    left += [f"{len(panoramas)} panoramas ({named(panoramas)})"] if panoramas else []
    return posed_set("opensfm", file, views, (), Account(left=tuple(left)))


def _view(name: str, shot: dict[str, Any], cameras: dict[str, Calibration | SizedCamera]) -> View:
    turn, translation = (
        np.array(shot[key], dtype=np.float64).reshape(3) for key in ("rotation", "translation")
    )
    return View(name, pose(cv2.Rodrigues(turn)[0], translation), cameras[shot["camera"]])


def _camera(entry: dict[str, Any], file: Path) -> Calibration | SizedCamera:
    kind = str(entry.get("projection_type", "perspective"))
    if kind not in _LENSES:
        return refused(f"a camera of type {kind}", file)
    lens, keys = _LENSES[kind]
    size = int(entry["width"]), int(entry["height"])
    side = max(size)
    fx, fy = (side * float(entry[k if k in entry else "focal"]) for k in ("focal_x", "focal_y"))
    cx, cy = (
        side * float(entry.get(key, 0)) + (edge - 1) / 2
        for key, edge in zip(("c_x", "c_y"), size, strict=True)
    )
    distortion = tuple(float(entry.get(key, 0)) for key in keys.split())
    return Calibration(fx, fy, cx, cy, distortion, *size, origin=str(file), lens=lens)
