"""7-Scenes: ``frame-000000.color.png, frame-000000.depth.png, ...`` in ``seq-01``."""

import re
from collections.abc import Container
from pathlib import Path

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.poses import FRAMES_PER_SECOND
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthCamera, DepthFile
from geogs.io.sources.images import ImageFile, ImageList, file_names
from geogs.io.sources.intrinsics import find_calibration

_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpg|jpeg)", re.IGNORECASE)
# The Kinect's nominal colour camera; the data set publishes no calibration of its own for colour.
_CAMERA = Calibration(
    525.0, 525.0, 320.0, 240.0, width=640, height=480,
    origin="the 7-Scenes colour camera, nominal", is_nominal=True,
)  # fmt: skip
_PER_METRE = 1000.0
# Depth has not been registered to colour: the sensor's nominal camera is 25 mm beside it.
_SENSOR = DepthCamera(Camera(585.0, 585.0, 320.0, 240.0, 640, 480), (-0.025, 0.0, 0.0))


def is_seven_scenes(folder: Path) -> bool:
    """Whether ``folder`` is a sequence or a scene with sequences."""
    return bool(_sequences(folder))


def open_seven_scenes(folder: Path) -> ImageList:
    """Read a sequence, or the only sequence of a scene; frame k is at k / 30 s."""
    sequences = _sequences(folder)
    if len(sequences) > 1:
        names = ", ".join(sequence.name for sequence in sequences)
        raise InputError(f"{folder} holds several sequences; give one of {names}.")
    sequence = sequences[0].resolve()
    matches = ((_NAME.fullmatch(path.name), path) for path in sequence.iterdir())
    numbered = sorted((int(match[1]), path) for match, path in matches if match)
    there = {*file_names(sequence)}
    files = [ImageFile(path, k / FRAMES_PER_SECOND, _depth(path, there)) for k, path in numbered]
    calibration = find_calibration(sequence, sequence.parent) or _CAMERA
    return ImageList("7scenes", f"{sequence.parent.name}-{sequence.name}", files, calibration)


def _depth(image: Path, there: Container[str]) -> DepthFile | None:
    path = image.with_name(image.name.split(".")[0] + ".depth.png")
    return DepthFile(path, _PER_METRE, _SENSOR) if path.name in there else None


def _sequences(folder: Path) -> list[Path]:
    if _has_frames(folder):
        return [folder]
    return sorted(path for path in folder.glob("seq-*") if path.is_dir() and _has_frames(path))


def _has_frames(folder: Path) -> bool:
    return any(_NAME.fullmatch(path.name) for path in folder.iterdir())
