"""Pose files: TUM trajectories, one matrix a row (Replica, KITTI), one file a frame (7-Scenes).

All poses are camera to world in OpenCV axes. Rows that hold no pose (NaN, inf, all zero) are
dropped, with a warning; a file whose numbers mean something else is an error.
"""

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from geogs.errors import InputError
from geogs.geometry.lie import quaternion_to_matrix
from geogs.guard.documents import first_file, numbered, read_text
from geogs.types import Trajectory

FRAMES_PER_SECOND = 30.0
"""Rate given to data sets that carry no time: frame k is at k / 30 s."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes x right, y down, z forward from x right, y up, z backward; it is its own inverse."""

POSE_FILES = ("groundtruth.txt", "traj.txt")
"""Names of files with the poses of a sequence in its folder."""
ORIENTATIONS = "orientations.tum"
"""File of a result with the frames whose orientation is known but not their position."""
_log = logging.getLogger(__name__)
_POSE_FILE = re.compile(r"frame-(\d+)\.pose\.txt")


def read_tum_trajectory(path: Path) -> Trajectory:
    """Read ``t tx ty tz qx qy qz qw`` rows (spaces or commas, ``#`` starts a comment).

    A file that begins with the quaternion 1 0 0 0 is refused: it is the unit rotation with w first,
    and hardly ever a half turn about x. Quaternions are normalised; rows are sorted by time.

    Raises:
        InputError: the file is missing, empty, not of eight columns, or its quaternions are not.
    """
    rows = read_rows(path, columns=(8,), layout="t tx ty tz qx qy qz qw")
    seconds = rows[:, 0]
    position = rows[:, 1:4]
    xyzw = rows[:, 4:]
    _check_quaternions(path, rows, _has_pose(np.column_stack([seconds, position]), xyzw))
    return quaternion_trajectory(path, seconds, position, xyzw)


def quaternion_trajectory(
    path: Path,
    seconds: Float[np.ndarray, "n"],
    position: Float[np.ndarray, "n 3"],
    xyzw: Float[np.ndarray, "n 4"],
) -> Trajectory:
    """Camera-to-world poses in order of time, without rows that hold none.

    Raises:
        InputError: no row of the file, ``path``, holds one.
    """
    rows = np.column_stack([seconds, position, xyzw])
    rows = _kept(path, rows, _has_pose(rows[:, :4], xyzw))
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    T_wc = poses_from(rows[:, 1:4], rows[:, 4:])
    return Trajectory(rows[:, 0].copy(), T_wc, np.ones(len(rows), dtype=bool))


def _has_pose(
    others: Float[np.ndarray, "n 4"], xyzw: Float[np.ndarray, "n 4"]
) -> Bool[np.ndarray, "n"]:
    norm = np.linalg.norm(xyzw, axis=1)
    return np.isfinite(others).all(axis=1) & (np.abs(norm - 1) < 0.1)


def read_frame_poses(folder: Path) -> Trajectory:
    """Read the frames of a result with a known pose, or only orientation, in order of time.

    Raises:
        InputError: ``trajectory.tum`` is missing, a file is damaged, or no frame is known at all.
    """
    files = [folder / "trajectory.tum"]
    if (folder / ORIENTATIONS).is_file():
        files = [file for file in (*files, folder / ORIENTATIONS) if _has_rows(file)] or files
    parts = [read_tum_trajectory(file) for file in files]
    only = np.concatenate(
        [
            np.full(len(part.timestamps), file.name == ORIENTATIONS)
            for part, file in zip(parts, files, strict=True)
        ]
    )
    times = np.concatenate([part.timestamps for part in parts])
    order = times.argsort(kind="stable")
    T_wc = np.concatenate([part.T_wc for part in parts])
    return Trajectory(times[order], T_wc[order], ~only[order], only[order])


def _has_rows(path: Path) -> bool:
    return any(line.strip() and line[0] != "#" for line in read_text(path).splitlines())


def poses_from(
    position: Float[np.ndarray, "n 3"], xyzw: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world matrices of positions and quaternions in the order of TUM files."""
    T_wc = np.tile(np.eye(4), (len(position), 1, 1))
    wxyz = np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]])
    T_wc[:, :3, :3] = quaternion_to_matrix(torch.from_numpy(wxyz)).numpy()
    T_wc[:, :3, 3] = position
    return T_wc


def read_replica_trajectory(path: Path) -> Trajectory:
    """Read one camera-to-world matrix a row: 16 numbers (Replica) or the upper 12 (KITTI).

    Row k is frame k at k / 30 s; rows without a pose are left out.
    """
    rows = read_rows(path, columns=(16, 12), layout="a 4x4 matrix a row")
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, : rows.shape[1] // 4] = rows.reshape(len(rows), -1, 4)
    seconds = np.arange(len(rows)) / FRAMES_PER_SECOND
    return matrix_trajectory(path, seconds, T_wc, is_rigid(T_wc))


def read_seven_scenes_poses(folder: Path) -> Trajectory:
    """Read the ``frame-<k>.pose.txt`` files of a 7-Scenes sequence; frame k is at k / 30 s."""
    files = numbered(folder.iterdir(), _POSE_FILE)
    if not files:
        raise InputError(f"{folder} holds no frame-*.pose.txt; give the folder of one sequence.")
    T_wc = np.stack([_read_matrix(path) for _, path in files])
    seconds = np.array([number for number, _ in files]) / FRAMES_PER_SECOND
    return matrix_trajectory(folder, seconds, T_wc, is_rigid(T_wc))


def read_poses(path: Path) -> Trajectory:
    """Read poses in whichever of the formats above ``path`` is: a folder, or rows of 8, 12, 16."""
    file = pose_file(path)
    if file is None:
        return read_seven_scenes_poses(path)
    return read_tum_trajectory(file) if columns_of(file) == 8 else read_replica_trajectory(file)


def pose_file(path: Path) -> Path | None:
    """The file with the poses: the path, or that in a folder; none in one of 7-Scenes."""
    return first_file(path / name for name in POSE_FILES) if path.is_dir() else path


def columns_of(path: Path) -> int:
    """How many numbers the first row of a file has; 0 where there is none."""
    return len(next(_numbers_by_line(path), (0, []))[1])


def _read_matrix(path: Path) -> Float[np.ndarray, "4 4"]:
    numbers = [number for _, line in _numbers_by_line(path) for number in line]
    if len(numbers) != 16:
        raise InputError(f"{path} should hold a 4x4 matrix but holds {len(numbers)} numbers.")
    return np.array(numbers, dtype=np.float64).reshape(4, 4)


def read_rows(path: Path, columns: tuple[int, ...], layout: str) -> Float[np.ndarray, "n k"]:
    """Read the rows of a file whose number of columns is one of these.

    Raises:
        InputError: it is not; ``layout`` names what was expected.
    """
    rows: list[list[float]] = []
    for line, numbers in _numbers_by_line(path):
        if len(numbers) not in columns or len(numbers) != len(rows[0] if rows else numbers):
            raise InputError(
                f"{path}, line {line}: expected {layout}, found {len(numbers)} numbers; "
                f"is the file cut off or of another format?"
            )
        rows.append(numbers)
    if not rows:
        raise InputError(f"{path} holds no poses; expected {layout}.")
    return np.array(rows, dtype=np.float64)


def _numbers_by_line(path: Path) -> Iterator[tuple[int, list[float]]]:
    for line, content in enumerate(read_text(path).splitlines(), start=1):
        words = content.split("#", 1)[0].replace(",", " ").split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            raise InputError(f"{path}, line {line}: not a row of numbers.") from None
        if numbers:
            yield line, numbers


def _check_quaternions(
    path: Path, rows: Float[np.ndarray, "n 8"], valid: Bool[np.ndarray, "n"]
) -> None:
    norm = np.linalg.norm(rows[:, 4:], axis=1)
    has_pose = np.isfinite(rows).all(axis=1) & (norm > 0)
    if valid.sum() < 0.5 * has_pose.sum():
        raise InputError(
            f"{path}: columns 5 to 8 are no unit quaternions; expected t tx ty tz qx qy qz qw."
        )
    first = rows[valid][:1, 4:]
    if len(first) and abs(first[0, 0]) > 1 - 1e-6:
        raise InputError(
            f"{path} begins with the quaternion 1 0 0 0, which is w x y z order; "
            f"TUM files hold qx qy qz qw, so move the w column to the end."
        )


def is_rigid(T: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, "n"]:
    """Return which matrices are finite, with a rotation to 1e-2 and a last row 0 0 0 1 to 1e-6."""
    finite = np.isfinite(T).all(axis=(1, 2))
    rotation = np.where(finite[:, None, None], T[:, :3, :3], 0.0)
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    last_row = np.where(finite[:, None], T[:, 3], 0.0)
    is_affine = np.abs(last_row - [0, 0, 0, 1]).max(axis=1) < 1e-6
    return finite & is_affine & (error < 1e-2) & (np.linalg.det(rotation) > 0)


def says_pose(T: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, "n"]:
    """Return which matrices are meant as a pose: finite, with a 3x3 part that is not all zero."""
    finite = np.isfinite(T).all(axis=(1, 2))
    return finite & (np.abs(np.where(finite[:, None, None], T, 0))[:, :3, :3].sum((1, 2)) > 0)


def matrix_trajectory(
    path: Path,
    seconds: Float[np.ndarray, "n"],
    T_wc: Float[np.ndarray, "n 4 4"],
    valid: Bool[np.ndarray, "n"],
) -> Trajectory:
    """Camera-to-world poses, without those that are not valid.

    Raises:
        InputError: most matrices of the file, ``path``, are no rigid motion, or none is valid.
    """
    if valid.sum() < 0.5 * says_pose(T_wc).sum():
        raise InputError(
            f"{path}: the matrices are no rigid motions; expected 4x4 camera-to-world matrices, "
            f"row by row, the last row 0 0 0 1."
        )
    T_wc = _kept(path, T_wc, valid)
    return Trajectory(seconds[valid], T_wc, np.ones(len(T_wc), dtype=bool))


def _kept(
    path: Path, rows: Float[np.ndarray, "n ..."], valid: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "m ..."]:
    dropped = int((~valid).sum())
    if dropped == len(valid):
        raise InputError(f"{path} holds no valid pose: all {dropped} rows are NaN, inf or zero.")
    if dropped:
        _log.warning(
            "%s: dropped %d of %d poses (not finite, or not rigid).", path, dropped, len(valid)
        )
    return rows[valid]
