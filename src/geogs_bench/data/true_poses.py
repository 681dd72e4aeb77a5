"""True poses of a scene, on the clock of its source."""

import re
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.io.pose_files import FRAMES_PER_SECOND, read_poses
from geogs.io.sources.formats.colmap import pose_of, read_model
from geogs.io.sources.formats.image_files import SUFFIXES, in_order_of_time
from geogs.io.sources.formats.scannet import open_posed_scannet
from geogs.types import Trajectory
from geogs_bench.data.benchmark_scene import BenchmarkScene, TruePoses


def read_true_poses(scene: BenchmarkScene) -> Trajectory | None:
    """Camera-to-world poses in metres, at the times that ``geogs run`` gives the images.

    Poses that are not finite (where the data set lost track) are left out. None where the scene
    has no poses. Raises InputError if they cannot be read.
    """
    poses = scene.truth.poses
    if poses is None:
        return None
    if poses.format == "poses":
        return read_poses(poses.path)
    numbered = _scannet(poses.path) if poses.format == "scannet" else _colmap(poses.path)
    times = _times(scene.source, poses)
    known = {k: T for k, T in numbered.items() if k in times and np.isfinite(T).all()}
    if not known:
        raise InputError(f"{poses.path} holds no valid pose for any image of {scene.source}.")
    order = sorted(known, key=lambda number: times[number])
    T_wc = np.linalg.inv(np.stack([known[k] for k in order]))
    stamps = np.array([times[k] for k in order], np.float64)
    return Trajectory(stamps, T_wc, np.ones(len(order), bool))


def _scannet(folder: Path) -> dict[int, np.ndarray]:
    """World to camera by frame number."""
    posed = open_posed_scannet(folder)
    return {round(file.timestamp * FRAMES_PER_SECOND): file.T_cw for file in posed.files}


def _colmap(folder: Path) -> dict[int, np.ndarray]:
    """World to camera by the number in the image's name."""
    images = read_model(folder).images.values()
    numbers = [(_number(image.name), pose_of(image)) for image in images]
    return {number: T_cw for number, T_cw in numbers if number is not None}


def _times(source: Path, poses: TruePoses) -> "dict[int, float] | _ByRate":
    """Time of each frame number: as a folder of images is read, or by a video's rate."""
    if not source.is_dir():
        return _ByRate(poses.rate)
    files = in_order_of_time([p for p in source.iterdir() if p.suffix.lower() in SUFFIXES])
    numbers = [(_number(file.path.name), file.timestamp) for file in files]
    return {number: time for number, time in numbers if number is not None}


class _ByRate:
    """Frame k is at k / rate."""

    def __init__(self, rate: float) -> None:
        self._rate = rate

    def __contains__(self, number: int) -> bool:
        return True

    def __getitem__(self, number: int) -> float:
        return number / self._rate


def _number(name: str) -> int | None:
    digits = re.findall(r"\d+", Path(name).stem)
    return int(digits[-1]) if digits else None
