"""7-Scenes: ``frame-000000.pose.txt`` beside each image, of the depth camera."""

import logging
from pathlib import Path

import numpy as np

from geogs.io.poses import FRAMES_PER_SECOND, read_seven_scenes_poses
from geogs.io.sources.posed.files import PosedFile, PosedSet
from geogs.io.sources.seven_scenes import is_seven_scenes, open_seven_scenes

COLOUR_FROM_DEPTH = np.array([-0.025, 0.0, 0.0])
"""Metres: X_colour = X_depth + this. Both cameras of the Kinect look the same way, side by side;
the data set neither registers colour to depth nor publishes where they are."""

_log = logging.getLogger(__name__)


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
    numbered = [(round(file.timestamp * FRAMES_PER_SECOND), file) for file in reader.files]
    files = tuple(
        PosedFile(file.path, T_cw[k], reader.calibration, None, file.timestamp)
        for k, file in numbered
        if k in T_cw
    )
    _log.info(
        "%s: the poses are those of the depth camera; the colour camera is taken to be 2.5 cm "
        "beside it.",
        reader.name,
    )
    return PosedSet("7scenes", reader.name, files, scene_scale="metres")
