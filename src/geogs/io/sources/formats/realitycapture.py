"""RealityCapture and RealityScan: "Internal/External camera parameters" (CSV), or XMP sidecars.

Focal lengths are those of 36 mm along the longer side; principal points are in units of it, from
the middle of the image; the first pixel's centre is (0.5, 0.5). t1 and t2 are OpenCV's p2 and p1,
as in the program's own template for OpenCV. Heading, pitch and roll turn a camera that looks down
with north on top: camera to world is Rz(-heading) Rx(pitch) Ry(roll) in OpenGL axes. The XMP's
matrix is world to camera in OpenCV axes, its position the camera's place; both agree.
https://dev.epicgames.com/documentation/realityscan (camera geometry)
"""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import read_text, read_xml
from geogs.io.pose_files import OPENCV_FROM_OPENGL
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    brown_lens,
    check_neglected,
    find_file,
    pose_at,
    posed_set,
    refused,
    understood,
)
from geogs.io.sources.named_files import IMAGE_FOLDERS
from geogs.io.sources.posed.posed_set import PosedSet

_FILM = 36.0
"""Width in millimetres of the film that focal lengths are for."""
_DEGREE = 1 / 500
"""Spread of x and y by that of the altitude below which they may be degrees."""
_COLUMNS = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""Names of columns since RealityScan 2, with the former ones."""
_NEEDED = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f"]
_TERMS = ["k1", "k2", "k3", "k4", "t1", "t2"]
_ATTRIBUTES = {
    "f": "FocalLength35mm",
    "px": "PrincipalPointU",
    "py": "PrincipalPointV",
    "skew": "Skew",
    "aspect": "AspectRatio",
}
"""Attributes of a sidecar for the columns of a table."""
_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_BROWN = ("brown3", "brown4", "brown3t2", "brown4t2")


def find_csv(path: Path) -> Path | None:
    """The table in a folder, or none; ``path`` may be the file."""
    return find_file(path, ("*.csv",), b"name,x,y,alt,", b",pitch,roll")


def open_csv(file: Path) -> PosedSet:
    """Read the images that the table lists, which are the aligned ones.

    Raises:
        InputError: columns are missing, or the table cannot be understood.
    """
    lines = [line for line in read_text(file).splitlines() if line.strip()]
    table = csv.reader(line for line in lines if not line.startswith("#cameras"))
    header = [word.strip().lstrip("#").lower() for word in next(table, [])]
    names = [_COLUMNS.get(word, word) for word in header]
    if missing := [name for name in _NEEDED if name not in names]:
        raise InputError(
            f"{file} has no column {', '.join(missing)}; export 'Internal/External camera "
            "parameters' of RealityCapture."
        )
    with understood(file):
        rows = [dict(zip(names, row, strict=True)) for row in table]
        views = [_row_view(row, file) for row in rows]
        places = np.array([[float(row[name]) for name in ("x", "y", "alt")] for row in rows])
        return posed_set("realitycapture", file, views, (), _units(places, file))


def _units(places: Float64[np.ndarray, "n 3"], file: Path) -> Account:
    """A sentence where x and y may be degrees beside an altitude in metres, which fits no image."""
    spread = np.ptp(places, axis=0) if len(places) else np.zeros(3)
    if not spread[:2].max() < _DEGREE * spread[2] or np.abs(places[:, :2]).max() > 180:
        return Account()
    said = f"x and y of {file} as lengths; if they are degrees, export in a local Euclidean system"
    return Account(used=(said,))


def _row_view(row: Mapping[str, str], file: Path) -> View:
    turns = [-float(row["heading"]), float(row["pitch"]), float(row["roll"])]
    from scipy.spatial.transform import Rotation  # other sources do not need it

    R_wc = Rotation.from_euler("ZXY", turns, degrees=True).as_matrix()
    R_cw = OPENCV_FROM_OPENGL[:3, :3] @ R_wc.T
    T_cw = pose_at(R_cw, np.array([float(row[name]) for name in ("x", "y", "alt")]))
    return View(row["name"].strip(), T_cw, _camera(row, "", file))


def find_xmp(path: Path) -> Path | None:
    """A sidecar with a pose in a folder of images, or none; ``path`` may be one."""
    patterns = ("*.xmp", *(f"{name}/*.xmp" for name in IMAGE_FOLDERS))
    return find_file(path, patterns, b"xcr:Rotation")


def open_xmp(file: Path) -> PosedSet:
    """Read the images of all sidecars in the folder of one.

    Raises:
        InputError: a sidecar cannot be understood.
    """
    views = []
    without = []
    for path in sorted(file.parent.glob("*.xmp")):
        if find_file(path, (), b"xcr:") is None:
            continue
        stated = _stated(read_xml(path))
        with understood(path):
            if not {"Rotation", "Position"} <= stated.keys():
                without.append(path.stem)
                continue
            rotation = np.array(stated["Rotation"].split(), dtype=np.float64).reshape(3, 3)
            centre = np.array(stated["Position"].split(), dtype=np.float64).reshape(3)
            views.append(View(path.stem, pose_at(rotation, centre), _xmp_camera(stated, path)))
    return posed_set("realitycapture", file.parent / "*.xmp", views, without)


def _stated(root: Element) -> dict[str, str]:
    """Attributes and elements of RealityCapture, which may be either, by their names."""
    found: dict[str, str] = {}
    for element in root.iter():
        pairs = {element.tag: element.text or "", **element.attrib}
        found |= {k.removeprefix(_XCR): v for k, v in pairs.items() if k.startswith(_XCR)}
    return found


def _xmp_camera(stated: Mapping[str, str], file: Path) -> SizedCamera:
    model = stated.get("DistortionModel", "perspective")
    numbers = stated.get("DistortionCoeficients", "").split() if model != "perspective" else []
    if model not in (*_BROWN, "perspective") and any(float(number) for number in numbers):
        return refused(f"a lens of type {model}", file)
    row = dict(zip(_TERMS, numbers, strict=False))
    row |= {key: stated.get(name, "") for key, name in _ATTRIBUTES.items()}
    return _camera(row, model, file)


def _camera(row: Mapping[str, str], model: str, file: Path) -> SizedCamera:
    """The camera of numbers by their names; a table does not say the ``model`` of the lens.

    Cameras of all sidecars have one origin, since images whose cameras are equal are one group.
    """
    origin = str(file.with_name("*.xmp") if model else file)
    numbers = {key: float(row.get(key) or 0) for key in ("f", "px", "py", "skew", *_TERMS)}
    aspect = float(row.get("aspect") or 1)

    def sized(width: int, height: int) -> Calibration:
        side = max(width, height)
        f = numbers["f"] / _FILM * side
        account = check_neglected({"skew": numbers["skew"] * height / 2}, file)
        if not model and numbers["k1"] and not any(numbers[term] for term in _TERMS[1:]):
            said = f"k1 of {file} as that of a Brown lens, RealityCapture's default"
            account += Account(used=(said,))
        centre = numbers["px"] * side + width / 2 - 0.5, numbers["py"] * side + height / 2 - 0.5
        radial = [numbers[term] for term in _TERMS[:4]]
        swapped = numbers["t2"], numbers["t1"]
        size = width, height
        return brown_lens((f, f * aspect), centre, radial, swapped, size, origin, account)

    if not math.isfinite(sum(numbers.values())) or numbers["f"] <= 0:
        raise ValueError
    return sized
