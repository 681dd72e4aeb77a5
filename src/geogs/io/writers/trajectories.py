"""Trajectories in the formats of TUM, KITTI and EuRoC; all are camera to world, OpenCV axes."""

from pathlib import Path

import numpy as np
import torch

from geogs.geometry.lie import matrix_to_quaternion
from geogs.guard.atomic import write_text
from geogs.io.pose_files import ORIENTATIONS
from geogs.types import Trajectory

_EUROC = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)


def write_trajectories(folder: Path, frames: Trajectory, keyframes: Trajectory) -> None:
    """Write ``trajectory.tum`` and ``keyframes.tum`` of a result or one of its stages.

    The first has the frames whose pose is known. Frames with only a known orientation go to
    ``orientations.tum``, at the position 0 0 0, where there are any.
    """
    write_tum_trajectory(folder / "trajectory.tum", frames.of("tracked"))
    turned = frames.of("orientation only")
    if len(turned.timestamps):
        turned.T_wc[:, :3, 3] = 0
        write_tum_trajectory(folder / ORIENTATIONS, turned)
    write_tum_trajectory(folder / "keyframes.tum", keyframes)


def write_tum_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write ``t tx ty tz qx qy qz qw`` of every pose.

    Reading it again gives the same numbers up to rounding.
    """
    wxyz = _quaternions(trajectory)
    rows = np.column_stack(
        [trajectory.timestamps, trajectory.T_wc[:, :3, 3], wxyz[:, 1:], wxyz[:, :1]]
    )
    text = "".join(_row(row, " ") for row in rows)
    write_text(path, f"# timestamp tx ty tz qx qy qz qw\n{text}")


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write twelve numbers a row, the upper 3x4 of camera to world; seconds in ``times.txt``.

    Rows follow each other in time; KITTI has no other mark of a frame.
    """
    rows = trajectory.T_wc[:, :3].reshape(-1, 12)
    write_text(path, "".join(_row(row, " ") for row in rows))
    times = "".join(f"{float(t)!r}\n" for t in trajectory.timestamps)
    write_text(path.with_name("times.txt"), times)


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """Write a ground truth's ``data.csv``: nanoseconds, position, quaternion w, x, y, z.

    The body is the camera; velocities and biases are left out.
    """
    poses = np.concatenate([trajectory.T_wc[:, :3, 3], _quaternions(trajectory)], axis=1)
    nanoseconds = np.round(trajectory.timestamps * 1e9).astype(np.int64)
    rows = (f"{t},{_row(p, ',')}" for t, p in zip(nanoseconds.tolist(), poses, strict=True))
    write_text(path, f"{_EUROC}\n" + "".join(rows))


def _quaternions(trajectory: Trajectory) -> np.ndarray:
    """Rotations camera to world as w, x, y, z."""
    return matrix_to_quaternion(torch.from_numpy(trajectory.T_wc[:, :3, :3])).numpy()


def _row(numbers: np.ndarray, between: str) -> str:
    return between.join(repr(float(number)) for number in numbers) + "\n"
