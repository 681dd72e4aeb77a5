"""Images with poses that were measured at other times."""

import numpy as np
from jaxtyping import Bool, Float64

from geogs.errors import InputError
from geogs.io.sources.formats.image_files import ImageList
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet
from geogs.types import Trajectory

MAX_GAP = 0.1
"""Longest gap between two measured poses for interpolation, in seconds."""
MAX_BEYOND = 0.02
"""Longest time of an image before the first or after the last measured pose, in seconds."""


def with_timed_poses(
    images: ImageList, trajectory: Trajectory, max_gap: float = MAX_GAP
) -> PosedSet:
    """Images with their poses, in metres; images without a measured pose are left out.

    Args:
        images: with their times, seconds.
        trajectory: of the camera that took them, camera to world.
        max_gap: longest gap between two poses for interpolation, in seconds.

    Raises:
        InputError: no image has a pose.
    """
    times = np.array([file.timestamp for file in images.files], dtype=np.float64)
    T_wc, known = poses_at(trajectory, times, max_gap)
    info = images.info
    if not known.any():
        raise InputError(
            f"No image of {info.name} has a pose: the times of its images and of its true poses do "
            f"not overlap; are they of one sequence?"
        )
    files = tuple(
        PosedFile(file.path, np.linalg.inv(T), info.calibration, None, file.timestamp)
        for file, T, is_known in zip(images.files, T_wc, known, strict=True)
        if is_known
    )
    posed = PosedSet(info.kind, info.name, files, scene_scale="metres", account=info.account)
    if known.all():
        return posed
    count = f"{int((~known).sum())} of {len(known)} images"
    return posed.left(f"{count}, at whose time no pose was measured")


def poses_at(
    trajectory: Trajectory, times: Float64[np.ndarray, "n"], max_gap: float
) -> tuple[Float64[np.ndarray, "n 4 4"], Bool[np.ndarray, "n"]]:
    """Interpolate camera-to-world poses between the measured ones; a mask has where it is possible.

    Positions linearly, rotations on the sphere; nothing is extrapolated: the first and last pose
    hold for ``MAX_BEYOND`` seconds outwards.
    """
    from scipy.spatial.transform import Rotation, Slerp

    stamps, first = np.unique(trajectory.timestamps, return_index=True)
    T = trajectory.T_wc[first]
    inside = times.clip(stamps[0], stamps[-1])
    after = np.searchsorted(stamps, inside).clip(1, max(len(stamps) - 1, 1))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    known = np.abs(times - inside) <= MAX_BEYOND
    if len(stamps) == 1:
        return np.repeat(T, len(times), axis=0), known
    before = after - 1
    gap = stamps[after] - stamps[before]
    nearest = np.minimum(inside - stamps[before], stamps[after] - inside)
    known &= (gap <= max_gap) | (nearest <= MAX_BEYOND / 10)
    fraction = ((inside - stamps[before]) / gap)[:, None]
    poses[:, :3, 3] = (1 - fraction) * T[before, :3, 3] + fraction * T[after, :3, 3]
    poses[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(T[:, :3, :3]))(inside).as_matrix()
    return poses, known
