"""``intrinsics.json``: the camera of the working images, that of the source, and its shutter."""

import json
from pathlib import Path

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.writers.atomic import write_text
from geogs.shutter.shutter import Shutter


def write_intrinsics(
    path: str | Path,
    camera: Camera,
    calibration: Calibration | None = None,
    shutter: Shutter | None = None,
) -> None:
    """Write the pinhole of the frames, and with it the calibration of the images as they came.

    The frames have a global shutter; that of the images as they came is written with its readout in
    seconds, by which rows were rectified.
    All in pixels with the centre of the first pixel at (0, 0). Given as ``intrinsics``,
    the file stands for the source's calibration where it has one.
    """
    document: dict[str, object] = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "first_pixel_centre": [0, 0],
    }
    if calibration is not None:
        document["source"] = {
            "width": calibration.width,
            "height": calibration.height,
            "fx": calibration.fx,
            "fy": calibration.fy,
            "cx": calibration.cx,
            "cy": calibration.cy,
            "distortion": list(calibration.distortion),
            "origin": calibration.origin,
            "is_guess": calibration.is_guess,
            **_refinement(calibration),
        }
    if shutter is not None:
        document["shutter"] = {"readout": shutter.readout, "origin": shutter.origin}
    write_text(path, json.dumps(document, indent=2) + "\n")


def _refinement(calibration: Calibration) -> dict[str, object]:
    """What the video said, if it was asked; deviations in pixels of the source's images."""
    said = calibration.refinement
    if said is None:
        return {}
    return {
        "focal_deviation": said.deviation,
        "k1_deviation": said.deviation_k1,
        "self_calibration": {
            "keyframes": said.keyframes,
            "frames": said.frames,
            "failure": said.failure,
        },
    }


def read_camera(path: str | Path) -> Camera:
    """The pinhole of the frames. Raises InputError if the file is missing or holds none."""
    try:
        k = json.loads(Path(path).read_text(encoding="utf-8"))
        fx, fy, cx, cy = (float(k[name]) for name in ("fx", "fy", "cx", "cy"))
        return Camera(fx, fy, cx, cy, int(k["width"]), int(k["height"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} holds no camera ({error}); was it changed?") from None
