"""Trajectories as TUM files: ``t tx ty tz qx qy qz qw``, camera to world."""

from pathlib import Path

import numpy as np
import torch

from geogs.geometry.lie import matrix_to_quaternion
from geogs.io.writers.atomic import write_text
from geogs.types import Trajectory


def write_trajectories(folder: Path, frames: Trajectory, keyframes: Trajectory) -> None:
    """``trajectory.tum`` and ``keyframes.tum`` of a result or one of its stages."""
    write_tum_trajectory(folder / "trajectory.tum", frames)
    write_tum_trajectory(folder / "keyframes.tum", keyframes)


def write_tum_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write every pose, so that reading it again gives the same numbers up to rounding.

    Poses that were only interpolated are written as well; ``tracked`` has no place in the format.
    """
    wxyz = matrix_to_quaternion(torch.from_numpy(trajectory.T_wc[:, :3, :3])).numpy()
    rows = np.column_stack([
        trajectory.timestamps, trajectory.T_wc[:, :3, 3], wxyz[:, 1:], wxyz[:, :1]
    ])  # fmt: skip
    lines = [" ".join(repr(float(number)) for number in row) for row in rows]
    write_text(path, "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines, ""]))
