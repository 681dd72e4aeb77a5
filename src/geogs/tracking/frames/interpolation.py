"""Interpolation of a gapless trajectory from poses of some frames and orientations of others."""

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.geometry.lie import retract, se3_inverse, se3_log
from geogs.types import Trajectory


def bridged(
    timestamps: Float[np.ndarray, "n"],
    T_cw: Sequence[Float64[Tensor, "4 4"] | None],
    R_cw: Sequence[Float64[Tensor, "3 3"] | None],
) -> Trajectory:
    """Return the trajectory of frames in order of time.

    Args:
        timestamps: seconds.
        T_cw: pose of each frame, world to camera; None where unknown.
        R_cw: orientation of each frame where only that is known, else None.

    Where only the orientation is known, the camera's centre is interpolated linearly, and constant
    beyond the ends. Where nothing is known, constant motion is assumed.
    """
    poses = list(T_cw)
    if any(R is not None for R in R_cw):
        centres = camera_centres(timestamps, poses)
        for n, R in enumerate(R_cw):
            if R is not None:
                T = torch.eye(4, dtype=torch.float64)
                T[:3, :3] = R
                T[:3, 3] = -R @ centres[n]
                poses[n] = T
    tracked, oriented = (np.array([x is not None for x in some], bool) for some in (T_cw, R_cw))
    return Trajectory(timestamps, interpolate(timestamps, poses), tracked, oriented)


def camera_centres(
    timestamps: Float[np.ndarray, "n"], T_cw: Sequence[Tensor | None]
) -> Float[Tensor, "n 3"]:
    """Interpolate camera centres linearly between known poses, constant beyond the ends."""
    at = [n for n, T in enumerate(T_cw) if T is not None]
    if not at:
        return torch.zeros(len(T_cw), 3, dtype=torch.float64)
    found = np.stack([se3_inverse(T)[:3, 3].cpu().numpy() for T in T_cw if T is not None])
    axes = [np.interp(timestamps, timestamps[at], found[:, k]) for k in range(3)]
    return torch.from_numpy(np.stack(axes, 1))


def interpolate(
    timestamps: Float[np.ndarray, "n"], T_cw: Sequence[Tensor | None]
) -> Float[np.ndarray, "n 4 4"]:
    """Return camera to world of every frame; gaps by constant motion, ends constant."""
    known = {n: T for n, T in enumerate(T_cw) if T is not None}
    out = np.tile(np.eye(4), (len(T_cw), 1, 1))
    if not known:
        return out
    indices = list(known)
    for n in range(len(T_cw)):
        next = bisect_left(indices, n)
        b = indices[min(next, len(indices) - 1)]
        a = n if b == n else indices[max(next - 1, 0)]
        T = known[a]
        if a != b:
            fraction = (timestamps[n] - timestamps[a]) / max(timestamps[b] - timestamps[a], 1e-9)
            T = retract(fraction * se3_log(known[b] @ se3_inverse(T)), T)
        out[n] = se3_inverse(T).cpu().numpy()
    return out
