"""``intrinsics.json``: the camera of the working images, that of the source, and its shutter."""

import json
from pathlib import Path
from typing import Any

from geogs.camera.shutter.shutter import Shutter
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.guard.atomic import write_text
from geogs.guard.documents import UNUSABLE, read_json, whole_number
from geogs.io.sources.calibration import Calibration

_MOST_PIXELS = 1 << 28


def write_intrinsics(
    path: str | Path,
    camera: Camera,
    calibration: Calibration | None = None,
    shutter: Shutter | None = None,
) -> None:
    """Write the pinhole of the frames, and the calibration and the shutter of the stored images.

    The readout, by which rows were rectified, is in seconds; all else is in pixels with the centre
    of the first pixel at (0, 0). Given as ``intrinsics``, the file means the calibration of the
    source where it has one.
    """
    document: dict[str, object] = {
        "model": "PINHOLE",
        **pinhole(camera),
        "first_pixel_centre": [0, 0],
    }
    if calibration is not None:
        document["source"] = {
            **pinhole(calibration),
            "lens": calibration.lens,
            "distortion": list(calibration.distortion),
            "origin": calibration.origin,
            "is_guess": calibration.is_guess,
            **_refinement(calibration),
        }
    if shutter is not None:
        document["shutter"] = {"readout": shutter.readout, "origin": shutter.origin}
    write_text(path, json.dumps(document, indent=2) + "\n")


def pinhole(camera: Camera | Calibration) -> dict[str, object]:
    """Size, focal lengths and principal point, by their names in documents."""
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def _refinement(calibration: Calibration) -> dict[str, object]:
    """Outcome of a self-calibration, if any; deviations in pixels of the source's images."""
    said = calibration.refinement
    if said is None:
        return {}
    k1, k2 = said.deviations or (None, None)
    return {
        "focal_deviation": said.deviation,
        "k1_deviation": k1,
        "k2_deviation": k2,
        "self_calibration": {
            "keyframes": said.keyframes,
            "frames": said.frames,
            "failure": said.failure,
        },
    }


def read_camera(path: str | Path) -> Camera:
    """The pinhole of the frames. Raises InputError if the file is missing or holds none."""
    try:
        return camera_of(read_json(path))
    except UNUSABLE:
        raise InputError(f"{path} holds no camera; was it changed?") from None


def camera_of(entry: Any) -> Camera:
    """The pinhole that an entry of a document describes, by the names of its fields.

    Raises:
        ValueError, TypeError, LookupError, ArithmeticError: there is none.
    """
    fx, fy, cx, cy = (float(entry[name]) for name in ("fx", "fy", "cx", "cy"))
    width, height = whole_number(entry["width"]), whole_number(entry["height"])
    if not (min(width, height) >= 1 and width * height <= _MOST_PIXELS):
        raise ValueError("no image has such a size")
    edge = max(width, height)
    has_view = all(1e-3 <= focal / edge <= 1e4 for focal in (fx, fy))
    if not (has_view and all(abs(centre) <= 1e3 * edge for centre in (cx, cy))):
        raise ValueError("no camera has such numbers")
    return Camera(fx, fy, cx, cy, width, height)
