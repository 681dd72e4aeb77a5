"""Calibration files: JSON (geogs, Replica, nerfstudio, apps), COLMAP text, OpenCV/ROS YAML, KITTI,
numbers.

COLMAP and nerfstudio put the centre of the first pixel at (1/2, 1/2); their principal points are
moved by half a pixel to the convention used here.
"""

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from geogs.camera.distortion import LensModel
from geogs.documents import (
    LARGEST_SETTINGS,
    UNUSABLE,
    read_json,
    read_text,
    whole_number,
    yaml_value,
)
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.data_set_cameras import (
    arkit_camera,
    is_kitti,
    kitti_camera,
    record3d_camera,
    scannetpp_camera,
)

Numbers = Sequence[float]

# Where each COLMAP camera model keeps fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3, ...
# (https://colmap.github.io/cameras.html); none stands for zero.
_COLMAP_MODELS: dict[str, tuple[int | None, ...]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
    # fx, fy, cx, cy and k1, k2, k3, k4
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL_FISHEYE": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 6, 7),
}
FISHEYE = "fisheye"
"""Word before the numbers of a fisheye."""
_FISHEYES = (FISHEYE, "equidistant", "opencv_fisheye", "kannala_brandt", "kb4")
"""Names of a fisheye in files, in lower case."""
_OTHER_LENSES = (
    "FISHEYE", "FOV", "EQUIDISTANT", "EQUIRECT", "OMNI", "EUCM", "DOUBLE", "SPHER", "MEI", "PRISM",
)  # fmt: skip
"""Parts of names of camera models that are not supported."""
_RECORD3D, _SCANNETPP = "metadata", "pose_intrinsic_imu.json"
"""Names of files with cameras of Record3D and of ScanNet++'s phone."""

_log = logging.getLogger(__name__)


def read_calibration(path: Path) -> Calibration:
    """Read the camera in ``path``; the format follows from the name and the content.

    Raises:
        InputError: the file is missing, unreadable, of no known format, or of another lens.
    """
    is_json = path.suffix == ".json" or path.name == _RECORD3D
    document, text = (read_json(path), "") if is_json else (None, _text_of_settings(path))
    try:
        if is_json:
            return _from_json(document, path)
        if path.suffix in (".yaml", ".yml"):
            return calibration_from_document(camera_document(path), path)
        if any(model in text for model in ("PINHOLE", "RADIAL", "OPENCV", "FISHEYE", "FOV")):
            return _from_colmap(text, path)
        if is_kitti(text):
            return kitti_camera(path, None)
        return arkit_camera(path) if path.suffix == ".pincam" else _from_numbers(text, path)
    except UNUSABLE as error:
        raise InputError(
            f"{path} is no calibration that can be understood{_reason(error)}; "
            f"give fx fy cx cy [k1 k2 p1 p2 [k3]], or fisheye fx fy cx cy [k1 k2 k3 k4]."
        ) from None


def camera_document(path: Path, name: str = "cam0") -> dict[str, Any]:
    """The camera of a YAML file, or the one of a name in Kalibr's chain.

    Raises:
        InputError: it cannot be read.
        ValueError: it is no description of a camera.
    """
    # OpenCV writes a directive and a tag that plain YAML readers refuse.
    text = re.sub(r"^%YAML.*$|!!opencv-matrix", "", _text_of_settings(path), flags=re.MULTILINE)
    document = yaml_value(text, str(path))
    if not isinstance(document, dict):
        raise ValueError
    camera: dict[str, Any] = document.get(name, document)
    return camera


def calibration_from_words(words: Sequence[str], origin: str) -> Calibration:
    """Build a calibration from numbers as words; ``fisheye`` may come first. Raises ValueError."""
    is_fisheye = words[:1] == [FISHEYE]
    numbers = [float(word) for word in (words[1:] if is_fisheye else words)]
    if not is_fisheye:
        return calibration_from_numbers(numbers, origin)
    if len(numbers) not in (4, 8):
        raise InputError(
            f"The intrinsics ({origin}) hold {len(numbers)} numbers; "
            f"expected fisheye,fx,fy,cx,cy[,k1,k2,k3,k4]."
        )
    fx, fy, cx, cy, *distortion = numbers
    return Calibration(fx, fy, cx, cy, tuple(distortion), origin=origin, lens="fisheye")


def calibration_from_numbers(numbers: Numbers, origin: str) -> Calibration:
    """Build a calibration from fx, fy, cx, cy[, k1, k2, p1, p2[, k3]] in pixels.

    A negative fy is that of ICL-NUIM, whose y axis points up though its images are upright.
    """
    if len(numbers) not in (4, 8, 9):
        raise InputError(
            f"The intrinsics ({origin}) hold {len(numbers)} numbers; "
            f"expected fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]."
        )
    fx, fy, cx, cy, *distortion = numbers
    if fy < 0 < fx:
        _log.info("fy (%s) is negative, of a y axis that points up; taken as positive.", origin)
    fy = abs(fy) if fx > 0 else fy
    return Calibration(fx, fy, cx, cy, distortion=tuple(distortion), origin=origin)


def _text_of_settings(path: Path) -> str:
    return read_text(path, LARGEST_SETTINGS)


def _reason(error: Exception) -> str:
    """The missing entry, if that is the error; the file's content is never quoted."""
    return f" (no entry {error})" if isinstance(error, KeyError) else ""


def _from_json(document: Any, path: Path) -> Calibration:
    if "K" in document:
        return replace(record3d_camera(document), origin=str(path))
    if path.name == _SCANNETPP:
        return scannetpp_camera(document, path)
    # "source" is the camera of the images as stored, in the intrinsics.json of a result.
    entry = document.get("source") or document.get("camera") or document
    if "fl_x" in entry:
        return calibration_from_nerfstudio(entry, path)
    return Calibration(
        float(entry["fx"]),
        float(entry["fy"]),
        float(entry["cx"]),
        float(entry["cy"]),
        distortion=tuple(float(number) for number in entry.get("distortion", ())),
        width=_optional_int(entry.get("width", entry.get("w"))),
        height=_optional_int(entry.get("height", entry.get("h"))),
        origin=str(path),
        is_guess=bool(entry.get("is_guess", False)),
        lens=_lens(str(entry.get("lens", "polynomial")), path),
    )


def calibration_from_nerfstudio(entry: dict[str, Any], path: Path) -> Calibration:
    """Translate the keys of ``transforms.json``; raises KeyError, TypeError or ValueError."""
    lens = _lens(str(entry.get("camera_model", "OPENCV")), path)
    keys = ("k1", "k2", "k3", "k4") if lens == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    distortion = tuple(float(entry.get(key, 0.0)) for key in keys)
    return Calibration(
        float(entry["fl_x"]),
        float(entry.get("fl_y", entry["fl_x"])),
        float(entry["cx"]) - 0.5,
        float(entry["cy"]) - 0.5,
        distortion=distortion if any(distortion) else (),
        width=_optional_int(entry.get("w")),
        height=_optional_int(entry.get("h")),
        origin=str(path),
        lens=lens,
    )


def _from_colmap(text: str, path: Path) -> Calibration:
    lines = [line.split() for line in text.splitlines() if line.strip() and line[0] != "#"]
    cameras = {tuple(words[1:]) for words in lines}
    if len(cameras) != 1:
        raise InputError(f"{path} holds {len(cameras)} different cameras; give a file with one.")
    model, width, height, *words = next(iter(cameras))
    parameters = [float(word) for word in words]
    return calibration_from_colmap(
        model, whole_number(width), whole_number(height), parameters, str(path)
    )


def calibration_from_colmap(
    model: str, width: int, height: int, parameters: Numbers, origin: str
) -> Calibration:
    """Translate a camera of COLMAP (https://colmap.github.io/cameras.html).

    Raises:
        InputError: the camera model is not supported.
    """
    if model not in _COLMAP_MODELS:
        _refuse_others(model, origin)
        raise InputError(
            f"{origin} describes a camera of a model that is not supported; undistort the images "
            f"with COLMAP's image_undistorter first."
        )
    fx, fy, cx, cy, *distortion = (
        0.0 if index is None else float(parameters[index]) for index in _COLMAP_MODELS[model]
    )
    return Calibration(
        fx, fy, cx - 0.5, cy - 0.5,
        distortion=tuple(distortion), width=width, height=height, origin=origin,
        lens="fisheye" if model.endswith("FISHEYE") else "polynomial",
    )  # fmt: skip


def calibration_from_document(document: dict[str, Any], path: Path) -> Calibration:
    """Translate a camera of :func:`camera_document`; raises the errors of UNUSABLE."""
    _refuse_others(str(document.get("camera_model", "")), path)
    lens = _lens(str(document.get("distortion_model", "")), path)
    if "intrinsics" in document:  # EuRoC and Kalibr
        fx, fy, cx, cy = document["intrinsics"]
        coefficients = document.get("distortion_coeffs", [])
        distortion = document.get("distortion_coefficients", coefficients)
    else:
        fx, _, cx, _, fy, cy = document["camera_matrix"]["data"][:6]
        distortion = document.get("distortion_coefficients", {}).get("data", [])
    width, height = document.get("resolution", (None, None))
    return Calibration(
        float(fx), float(fy), float(cx), float(cy),
        distortion=tuple(float(number) for number in distortion),
        width=_optional_int(document.get("image_width", width)),
        height=_optional_int(document.get("image_height", height)),
        origin=str(path),
        lens=lens,
    )  # fmt: skip


def _from_numbers(text: str, path: Path) -> Calibration:
    rows = [line.split("#", 1)[0].replace(",", " ").split() for line in text.splitlines()]
    words = [word for row in rows for word in row]
    if words[:1] == [FISHEYE]:
        return calibration_from_words(words, str(path))
    numbers = [[float(word) for word in row] for row in rows if row]
    if len(numbers) >= 3 and all(len(row) == len(numbers) for row in numbers):
        return Calibration(  # a 3x3 or 4x4 matrix
            numbers[0][0], numbers[1][1], numbers[0][2], numbers[1][2], origin=str(path)
        )
    return calibration_from_numbers([number for row in numbers for number in row], str(path))


def _lens(model: str, path: Path | str) -> LensModel:
    """Lens model by its name in a file. Raises InputError for one that is not supported."""
    if model.lower() in _FISHEYES:
        return "fisheye"
    _refuse_others(model, path)
    return "polynomial"


def _refuse_others(model: str, path: Path | str) -> None:
    is_other = any(word in model.upper() for word in _OTHER_LENSES)
    if is_other:
        name = f"{model} camera" if re.fullmatch(r"\w{1,40}", model) else "camera of another model"
        raise InputError(
            f"{path} describes a {name}, which is not supported; undistort the images first."
        )


def _optional_int(number: Any) -> int | None:
    return None if number is None else whole_number(number)
