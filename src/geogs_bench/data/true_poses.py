"""True poses of a scene, on the clock of its source."""

import re
from pathlib import Path

import numpy as np

from geogs.evaluation.true_scene import read_true_scene
from geogs.io.sources.formats.colmap import is_model, pose_of, read_model
from geogs.types import Trajectory
from geogs_bench.data.benchmark_scene import BenchmarkScene

SAME_TIME = 0.005
"""Largest time between an image and its pose, seconds."""
_VIDEO_RATE = 60.0
"""Frames per second of ScanNet++'s videos."""


def read_true_poses(scene: BenchmarkScene) -> Trajectory | None:
    """Camera-to-world poses in metres, at the times of the images in ``geogs run``.

    Poses that are not finite (tracking failures of the data set) are left out. None if the scene
    has no poses. Raises InputError if they cannot be read.
    """
    path = scene.truth.poses
    if path is None:
        return None
    return _of_video(path) if is_model(path) else read_true_scene(path).trajectory


def _of_video(model: Path) -> Trajectory:
    """Poses of a COLMAP model; the last number in the name of an image is its frame."""
    found = {}
    for image in read_model(model).images.values():
        digits = re.findall(r"\d+", Path(image.name).stem)
        T_cw = pose_of(image)
        if digits and np.isfinite(T_cw).all():
            found[int(digits[-1])] = T_cw
    T_cw = np.array([found[k] for k in sorted(found)]).reshape(-1, 4, 4)
    times = np.array(sorted(found)) / _VIDEO_RATE
    return Trajectory(times, np.linalg.inv(T_cw), np.ones(len(times), bool))
