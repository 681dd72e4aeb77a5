"""7-Scenes: ``frame-000000.color.png, frame-000000.depth.png, ...`` in ``seq-01``.

``frame-000000.pose.txt`` beside each image is the pose of the depth camera.
"""

import logging
import re
from collections.abc import Container
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.guard.documents import numbered
from geogs.io.pose_files import FRAMES_PER_SECOND, read_seven_scenes_poses
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthCamera, DepthFile
from geogs.io.sources.formats.image_files import ImageFile, ImageList, file_names
from geogs.io.sources.known_intrinsics import find_calibration
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet

_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpg|jpeg)", re.IGNORECASE)
# The Kinect's nominal colour camera; the data set publishes no calibration of its own for colour.
_CAMERA = Calibration(
    525.0,
    525.0,
    320.0,
    240.0,
    width=640,
    height=480,
    origin="the 7-Scenes colour camera, nominal",
    is_nominal=True,
)
COLOUR_FROM_DEPTH = (-0.025, 0.0, 0.0)
"""Metres: X_colour = X_depth + this. Both cameras of the Kinect look the same way, side by side;
the data set neither registers depth to colour nor publishes their positions."""
_SENSOR = DepthCamera(Camera(585.0, 585.0, 320.0, 240.0, 640, 480), COLOUR_FROM_DEPTH)

_log = logging.getLogger(__name__)


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
    there = {*file_names(sequence)}
    files = [
        ImageFile(path, k / FRAMES_PER_SECOND, _depth(path, there))
        for k, path in numbered(sequence.iterdir(), _NAME)
    ]
    calibration = find_calibration(sequence, sequence.parent) or _CAMERA
    return ImageList("7scenes", f"{sequence.parent.name}-{sequence.name}", files, calibration)


def is_posed_seven_scenes(folder: Path) -> bool:
    """Whether ``folder`` is a sequence, or a scene with sequences, with its poses."""
    if not is_seven_scenes(folder):
        return False
    return any(folder.glob("frame-*.pose.txt")) or any(folder.glob("seq-*/frame-*.pose.txt"))


def open_posed_seven_scenes(folder: Path) -> PosedSet:
    """Read a sequence, or the only sequence of a scene; images without a pose are left out."""
    reader = open_seven_scenes(folder)
    sequence = reader.files[0].path.parent
    trajectory = read_seven_scenes_poses(sequence)
    colour = np.eye(4)
    colour[:3, 3] = COLOUR_FROM_DEPTH
    frames = np.rint(trajectory.timestamps * FRAMES_PER_SECOND).astype(int)
    T_cw = {int(k): colour @ np.linalg.inv(T) for k, T in zip(frames, trajectory.T_wc, strict=True)}
    files = tuple(
        PosedFile(file.path, T_cw[k], reader.info.calibration, None, file.timestamp)
        for file in reader.files
        if (k := round(file.timestamp * FRAMES_PER_SECOND)) in T_cw
    )
    _log.info(
        "%s: the poses are those of the depth camera; the colour camera is taken to be 2.5 cm "
        "beside it.",
        reader.info.name,
    )
    return PosedSet("7scenes", reader.info.name, files, scene_scale="metres")


def _depth(image: Path, there: Container[str]) -> DepthFile | None:
    path = image.with_name(image.name.split(".")[0] + ".depth.png")
    return DepthFile(path, sensor=_SENSOR) if path.name in there else None


def _sequences(folder: Path) -> list[Path]:
    if _has_frames(folder):
        return [folder]
    return sorted(path for path in folder.glob("seq-*") if path.is_dir() and _has_frames(path))


def _has_frames(folder: Path) -> bool:
    return any(_NAME.fullmatch(path.name) for path in folder.iterdir())
