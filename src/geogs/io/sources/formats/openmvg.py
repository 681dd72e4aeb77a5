"""OpenMVG: ``sfm_data.json`` with the views, intrinsics and extrinsics of a reconstruction.

Extrinsics are the rotation world to camera and the camera's place. Principal points count pixels
whose centres are integers, as OpenMVG resamples images. A type of intrinsics has its name only
where it is first mentioned, a number after that (cereal).
https://openmvg.readthedocs.io/en/latest/software/SfM/SfM_OutputFormat/
"""

from pathlib import Path
from typing import Any

import numpy as np

from geogs.camera.distortion import LensModel
from geogs.guard.documents import LARGEST_TEXT, read_bytes, read_json
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    find_files,
    pose_at,
    posed_set,
    refused,
    understood,
)
from geogs.io.sources.posed.posed_set import PosedSet

_FILES = ("sfm_data*.json", "*/sfm_data*.json", "*/*/sfm_data*.json")
_LENSES: dict[str, tuple[LensModel, str, tuple[int | None, ...]]] = {
    "pinhole": ("polynomial", "", ()),
    "pinhole_radial_k1": ("polynomial", "disto_k1", (0, None, None, None)),
    "pinhole_radial_k3": ("polynomial", "disto_k3", (0, 1, None, None, 2)),
    "pinhole_brown_t2": ("polynomial", "disto_t2", (0, 1, 3, 4, 2)),
    "fisheye": ("fisheye", "fisheye", (0, 1, 2, 3)),
}
"""Lens of each type, the key of its coefficients, and their places in OpenCV's order."""
Camera = Calibration | SizedCamera
_FIRST = 0x7FFFFFFF
"""Bits of a number without the one that marks its first mention."""


def find_openmvg(path: Path) -> Path | None:
    """The file of a project folder with most poses, or none; ``path`` may be the file."""
    files = find_files(path, _FILES, b'"sfm_data_version"')
    return max(files, key=lambda file: read_bytes(file).count(b'"center"'), default=None)


def open_openmvg(file: Path) -> PosedSet:
    """Read the views that have a pose.

    Raises:
        InputError: there are none, or the file cannot be understood.
    """
    document = read_json(file, LARGEST_TEXT)
    with understood(file):
        cameras = _cameras(document["intrinsics"], file)
        poses = {entry["key"]: entry["value"] for entry in document["extrinsics"]}
        listed = [entry["value"]["ptr_wrapper"]["data"] for entry in document["views"]]
        views = [_view(v, poses[v["id_pose"]], cameras) for v in listed if v["id_pose"] in poses]
        without = [_name(view) for view in listed if view["id_pose"] not in poses]
    return posed_set("openmvg", file, views, without)


def _name(view: dict[str, Any]) -> str:
    """Path below the folder of the images; ``local_path`` ends with a separator, or is one."""
    return f"{view.get('local_path', '')}/{view['filename']}".replace("\\", "/").lstrip("/")


def _view(view: dict[str, Any], pose: dict[str, Any], cameras: dict[int, Camera]) -> View:
    rotation = np.array(pose["rotation"], dtype=np.float64).reshape(3, 3)
    T_cw = pose_at(rotation, np.array(pose["center"], dtype=np.float64).reshape(3))
    return View(_name(view), T_cw, cameras.get(view["id_intrinsic"]))


def _cameras(entries: list[dict[str, Any]], file: Path) -> dict[int, Camera]:
    types: dict[int, str] = {}
    cameras = {}
    for entry in entries:
        value = entry["value"]
        number = int(value["polymorphic_id"]) & _FIRST
        types[number] = str(value.get("polymorphic_name", types.get(number, "")))
        data = value["ptr_wrapper"]["data"]
        # Later versions keep what all types share in a part of its own.
        shared = {key: part for key, part in data.items() if not isinstance(part, dict)}
        for part in data.values():
            shared |= part if isinstance(part, dict) else {}
        cameras[entry["key"]] = _camera(types[number], shared, file)
    return cameras


def _camera(kind: str, data: dict[str, Any], file: Path) -> Camera:
    if kind not in _LENSES:
        return refused(f"a camera of type {kind}", file)
    lens, key, places = _LENSES[kind]
    numbers = [float(number) for number in data[key]] if key else []
    distortion = tuple(0.0 if place is None else numbers[place] for place in places)
    focal = float(data["focal_length"])
    cx, cy = (float(number) for number in data["principal_point"])
    size = int(data["width"]), int(data["height"])
    return Calibration(focal, focal, cx, cy, distortion, *size, origin=str(file), lens=lens)
