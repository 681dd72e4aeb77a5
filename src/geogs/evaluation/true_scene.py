"""True poses of any data set, and the images that belong to them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.surfaces.silhouettes import Silhouette
from geogs.io.pose_files import POSE_FILES
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.sniff import open_posed_source
from geogs.io.sources.truth_files import read_truth
from geogs.types import Trajectory

_METRES = {"millimetres": 0.001}
_MODEL = ("images.txt", "cameras.txt")
"""Files of a COLMAP model; each one may be given for it."""


@dataclass(frozen=True)
class TrueScene:
    """Ground truth of the cameras."""

    path: Path
    trajectory: Trajectory
    """Poses in metres (or the data set's own unit where that is arbitrary)."""
    clock: str
    """Where their times are from, in words."""
    metres: float = 1.0
    """Metres per unit of the data set."""

    def images(self, long_edge: int) -> PosedSource:
        """The images with their poses in the data set's unit, at most ``long_edge`` pixels.

        Raises:
            InputError: there are no images at the path.
        """
        return open_posed_source(self.path, InputConfig(long_edge=long_edge))


def read_true_scene(path: Path) -> TrueScene:
    """Read true poses: a pose file, a folder with one, or any image set with known poses.

    For a data set with several cameras, the poses are of the camera whose image folder is given,
    else of the default camera of the sequence.

    Raises:
        InputError: there are no poses.
    """
    try:
        trajectory, clock = read_truth(path)
        return TrueScene(path, trajectory, clock)
    except InputError as error:
        is_model = path.is_file() and path.name in _MODEL
        is_table = path.is_file() and path.suffix in (".txt", ".tum", ".csv", ".traj", ".freiburg")
        if not path.exists() or (is_table and not is_model):
            raise
        try:
            source = open_posed_source(path)
        except InputError as why:
            is_named = any((path / name).is_file() for name in POSE_FILES)
            raise (why if is_model or (path.is_dir() and not is_named) else error) from None
    metres = _METRES.get(source.scene_scale, 1.0)
    T_wc = np.linalg.inv(source.T_cw)
    T_wc[:, :3, 3] *= metres
    trajectory = Trajectory(source.timestamps, T_wc, np.ones(len(T_wc), bool))
    return TrueScene(path, trajectory, "the times of its images", metres)


def scaled(trajectory: Trajectory, factor: float) -> Trajectory:
    """The trajectory in another unit of length."""
    T_wc = trajectory.T_wc.copy()
    T_wc[:, :3, 3] *= factor
    return replace(trajectory, T_wc=T_wc)


def silhouettes(source: PosedSource) -> list[Silhouette] | None:
    """The masks of a data set, in its unit; none where an image has no mask."""
    result = []
    for image in source:
        if image.mask is None:
            return None
        result.append(Silhouette(image.mask, source.camera, image.T_cw))
    return result
