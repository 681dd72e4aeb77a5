"""Pose priors: poses of another tracker beside the images, and the choice of those to use."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.geometry.lie import se3_inverse, so3_exp, so3_log
from geogs.guard.documents import expanded
from geogs.io.pose_files import is_rigid, read_tum_trajectory
from geogs.io.sources.account import Account
from geogs.io.sources.reader import RecordingInfo
from geogs.types import MeasuredPose, Trajectory

LONGEST_GAP = 0.25
"""Longest gap between two poses for interpolation, in seconds."""
NEAR = 0.02
"""Longest time before the first and after the last pose at which that is used, in seconds."""
KEYWORDS = ("none", "auto", "prior")
"""Values of ``input.poses`` other than a file."""


def pose_at(poses: Trajectory, seconds: float) -> MeasuredPose | None:
    """The pose at a time, interpolated between its two neighbours; none if they are far."""
    times = poses.timestamps
    T_wc = poses.T_wc
    after = int(np.searchsorted(times, seconds))
    if after == 0 or after == len(times):
        end = min(after, len(times) - 1)
        return measured_pose(T_wc[end]) if abs(times[end] - seconds) <= NEAR else None
    before = after - 1
    gap = times[after] - times[before]
    if gap > LONGEST_GAP:
        return None
    a, b = (torch.from_numpy(T_wc[k]) for k in (before, after))
    fraction = (seconds - times[before]) / gap if gap > 0 else 0.0
    T = a.clone()
    T[:3, :3] = a[:3, :3] @ so3_exp(fraction * so3_log(a[:3, :3].mT @ b[:3, :3]))
    T[:3, 3] = torch.lerp(a[:3, 3], b[:3, 3], fraction)
    return measured_pose(T.numpy())


def measured_pose(T_wc: Float64[np.ndarray, "4 4"]) -> MeasuredPose:
    """Make a measured pose from camera to world, OpenCV axes, metres."""
    return MeasuredPose(se3_inverse(torch.from_numpy(np.ascontiguousarray(T_wc))))


def rigid_pose(T_wc: Float64[np.ndarray, "4 4"], quarter_turns: int = 0) -> MeasuredPose | None:
    """A pose from camera to world, OpenCV axes, metres, with the nearest rotation; none where it is
    no rigid motion. Its images were turned upright by clockwise ``quarter_turns``."""
    if not is_rigid(T_wc[None])[0]:
        return None
    u, _, vt = np.linalg.svd(T_wc[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = T_wc[:3, 3]
    return measured_pose(turned_upright(rigid, quarter_turns))


def turned_upright(
    T_wc: Float64[np.ndarray, "4 4"], quarter_turns: int
) -> Float64[np.ndarray, "4 4"]:
    """The pose of the camera whose images were turned clockwise by quarter turns."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter_turns % 4]
    turned = np.eye(4)
    turned[:2, :2] = [[c, s], [-s, c]]  # upright axes to stored ones
    return T_wc @ turned


@dataclass(frozen=True)
class ChosenPoses:
    """The pose priors that a source uses."""

    is_used: bool = False
    file: Trajectory | None = None
    """Poses in place of the reader's."""
    account: Account = field(default_factory=Account)
    """The poses that are used, or left and why."""

    def of(self, seconds: float, own: MeasuredPose | None) -> MeasuredPose | None:
        """The pose of an image: the file's, or its ``own`` from the reader, or none."""
        if not self.is_used:
            return None
        return own if self.file is None else pose_at(self.file, seconds)


def chosen_poses(asked: str, info: RecordingInfo) -> ChosenPoses:
    """The pose priors that ``input.poses`` selects.

    Raises:
        InputError: there are none, or the file cannot be read.
    """
    word = asked.strip().lower()
    if word == "none":
        return ChosenPoses()
    if word not in KEYWORDS:
        poses = read_tum_trajectory(expanded(asked))
        used = f"poses: {len(poses.timestamps)} of {asked} as priors"
        return ChosenPoses(True, poses, Account((used,)))
    if word == "prior" and not info.has_poses:
        raise InputError(
            f"{info.name} has no poses of another tracker beside its images that can be read here; "
            "name their file (rows t tx ty tz qx qy qz qw), or leave out --poses."
        )
    if not info.has_poses:
        return ChosenPoses()
    if word == "prior" or info.is_capture:
        return ChosenPoses(True, account=Account(("poses beside the images as priors",)))
    return ChosenPoses(account=Account(left=("poses beside the images: --poses prior uses them",)))
