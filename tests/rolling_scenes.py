"""The textured room of ``tracking_scenes`` as a rolling shutter sees it, every row at its time."""

from collections.abc import Callable

import numpy as np
import torch

from geogs.camera.distortion import LensModel
from geogs.geometry.camera import Camera
from geogs.geometry.lie import so3_exp
from geogs.types import Frame
from lenses import undistorted_rays
from tracking_scenes import CAMERA, render, seen

Path = Callable[[float], np.ndarray]
"""The pose T_wc at a time in seconds."""
READOUT = 0.03
RATE = 30.0
"""Images per second."""


def hand_held(time: float) -> np.ndarray:
    """A hand that turns by up to a radian per second about changing axes, and moves a little."""
    t = 2 * np.pi * time
    angles = [0.10 * np.sin(1.1 * t), 0.16 * np.sin(0.9 * t + 1), 0.05 * np.sin(1.4 * t + 2)]
    T = np.eye(4)
    T[:3, :3] = so3_exp(torch.tensor(angles, dtype=torch.float64)).numpy()
    T[:3, 3] = [0.25 * np.sin(0.5 * t), 0.05 * np.sin(0.8 * t), -0.6 + 0.1 * np.cos(0.6 * t)]
    return T


def turning(rate: np.ndarray) -> Path:
    """A camera that only turns, at a rate in its own axes, radians per second (of the world in the
    camera: ``X_camera(t) = Exp(rate t) X_camera(0)``)."""

    def pose_at(time: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = so3_exp(torch.tensor(-rate * time)).numpy()
        return T

    return pose_at


def rolling_image(
    path: Path,
    time: float,
    readout: float = READOUT,
    camera: Camera = CAMERA,
    distortion: tuple[float, ...] = (),
    lens: LensModel = "polynomial",
) -> np.ndarray:
    """Image of a sensor whose middle row is seen at ``time``."""
    lines = np.arange(camera.height) / (camera.height - 1) - 0.5
    poses = np.stack([path(time + s * readout) for s in lines])
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = undistorted_rays(np.stack([u.ravel(), v.ravel()], 1), camera, distortion, lens)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], 1).reshape(*u.shape, 3)
    directions = np.einsum("hij,hwj->hwi", poses[:, :3, :3], rays)
    return seen(poses[:, None, :3, 3], directions)[0]


def global_image(path: Path, time: float, camera: Camera = CAMERA) -> np.ndarray:
    """Image of a global shutter."""
    return render(path(time), camera)[0]


def rolling_frames(path: Path, count: int, readout: float = READOUT) -> list[Frame]:
    """Video of a rolling shutter."""
    times = np.arange(count) / RATE
    return [Frame(k, t, rolling_image(path, t, readout)) for k, t in enumerate(times)]
