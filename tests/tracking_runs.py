"""A short path to track, and the error of what was tracked."""

import numpy as np
import torch

from geogs.config import TrackingConfig
from geogs.geometry.umeyama import umeyama
from tracking_scenes import sideways

CONFIG = TrackingConfig(init_keyframes=5)


PATH = sideways(40)


def metric_errors_cm(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors of all camera centres, metres taken for metres, the first poses on each other."""
    there = truth[0] @ np.linalg.inv(estimate[0]) @ estimate
    return 100 * np.linalg.norm((there - truth)[:, :3, 3], axis=1)


def error_cm(estimate: np.ndarray, truth: np.ndarray) -> float:
    """RMSE of camera centres after a similarity, centimetres."""
    x, y = torch.from_numpy(estimate), torch.from_numpy(truth)
    scale, R, t = umeyama(x, y)
    return 100 * float((scale * x @ R.T + t - y).square().sum(1).mean().sqrt())
