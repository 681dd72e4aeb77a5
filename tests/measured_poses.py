"""Poses as another tracker would say them: with a drift, an error of scale, and some far off."""

from itertools import pairwise

import numpy as np
import torch

from geogs.geometry.lie import se3_exp
from geogs.types import Frame, MeasuredPose


def drifting(
    path: list[np.ndarray],
    seed: int = 0,
    scale: float = 1.0,
    drift: float = 0.01,
    turn_deg: float = 0.3,
    wrong: float = 0.0,
) -> list[MeasuredPose]:
    """Poses of a path whose steps are off by a share of their length and by degrees a metre.

    ``wrong`` is the share of the poses that are somewhere else; all are in a world of their own.
    """
    rng = np.random.default_rng(seed)
    T_wc = [np.linalg.inv(path[0])]
    axis = rng.standard_normal(3)
    axis *= np.radians(turn_deg) / np.linalg.norm(axis)
    for before, after in pairwise(path):
        step = np.linalg.inv(before) @ after
        length = np.linalg.norm(step[:3, 3])
        step[:3, 3] = scale * step[:3, 3] + drift * length * rng.standard_normal(3)
        turned = se3_exp(torch.from_numpy(np.r_[np.zeros(3), axis * length])).numpy()
        T_wc.append(T_wc[-1] @ step @ turned)
    for n in np.flatnonzero(rng.random(len(T_wc)) < wrong):
        away = torch.from_numpy(0.5 * rng.standard_normal(6))
        T_wc[n] = T_wc[n] @ se3_exp(away).numpy()
    return [MeasuredPose(torch.from_numpy(np.linalg.inv(T))) for T in T_wc]


def with_poses(frames: list[Frame], poses: list[MeasuredPose]) -> list[Frame]:
    """Frames with the poses that another tracker says."""
    return [
        Frame(f.index, f.timestamp, f.image, f.follows_cut, f.depth, pose)
        for f, pose in zip(frames, poses, strict=True)
    ]
