"""Sequences with true poses for the benchmarks of parts of the system."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from geogs.config import InputConfig
from geogs.evaluation.trajectory_errors import associate
from geogs.evaluation.true_scene import read_true_scene
from geogs.geometry.camera import Camera
from geogs.geometry.umeyama import umeyama
from geogs.io.sources.sniff import open_source
from geogs.types import Frame

COLOUR = 0.025
"""Offset of the colour camera of 7-Scenes to the right of the depth camera, whose poses are given,
metres."""


@dataclass(frozen=True)
class Sequence:
    """Frames with their true poses."""

    camera: Camera
    frames: list[Frame]
    T_wc: np.ndarray


def load(folder: Path, config: InputConfig) -> Sequence:
    """Load a folder in the layout of Replica or 7-Scenes; frames without a pose are left out."""
    source, truth = open_source(folder, config), read_true_scene(folder).trajectory
    frames = list(source)
    i, j = associate(truth.timestamps, np.array([frame.timestamp for frame in frames]), 0.005)
    T_wc = truth.T_wc[i].copy()
    if (folder / "seq-01").is_dir():
        T_wc[:, :3, 3] += COLOUR * T_wc[:, :3, 0]
    return Sequence(source.camera, [frames[k] for k in j], T_wc)


def align(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """ATE RMSE in cm after Sim(3) alignment of camera centres, and the scale of the alignment."""
    x, y = torch.from_numpy(estimate), torch.from_numpy(truth)
    scale, R, t = umeyama(x, y)
    error = (scale * x @ R.T + t - y).norm(dim=1)
    return 100 * float(error.square().mean().sqrt()), float(scale)
