"""Points that a rolling shutter sees one by one, with the clips that are made of them."""

from collections.abc import Callable

import numpy as np

from geogs.camera.shutter.angular_motion import rotated
from geogs.camera.shutter.clip_tracks import ClipTracks
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.geometry.camera import Camera

WIDE = RollingCamera(Camera(420.0, 420.0, 255.5, 191.5, 512, 384))
FOCAL = 420.0
RATE = 30.0
Path = Callable[[float], tuple[np.ndarray, np.ndarray]]


def shaken(seed: int) -> Path:
    """Rotation vector and position of the world in a camera that a hand shakes."""
    phases, sizes = np.random.default_rng(seed).uniform(0.5, 1, (2, 6))
    waves = 2 * np.pi * np.linspace(1.0, 2.2, 6)

    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        wave = sizes * np.sin(waves * time + 6 * phases)
        return 0.06 * wave[:3], 0.12 * wave[3:]

    return at


def steady(seed: int) -> Path:
    """One that goes by without turning, at a constant speed."""
    return lambda time: (np.zeros(3), np.array([0.4, 0.01 * seed, 0.0]) * time)


def seen(path: Path, points: np.ndarray, time: float, readout: float) -> np.ndarray:
    """Pixels of the points in the image whose middle row is seen at a time, one by one in turn."""
    times = np.full(len(points), time)
    for _ in range(5):
        turns, moves = zip(*map(path, times), strict=True)
        pixels = WIDE.pixels(rotated(points, np.array(turns)) + np.array(moves))
        times = time + readout * WIDE.line_times(pixels)
    return pixels


def scattered(seed: int, count: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-2.4, -1.8, 2.5], [2.4, 1.8, 6], (count, 3))


def clip_of(
    path: Path,
    points: np.ndarray,
    readout: float,
    images: int = 30,
    rate: float = RATE,
) -> ClipTracks:
    """Views of points with a twentieth of a pixel of noise; every tenth view is missing."""
    rng = np.random.default_rng(0)
    times = (np.arange(images) - images // 2) / rate
    pixels = np.stack([seen(path, points, t, readout) for t in times])
    pixels += rng.normal(0, 0.05, pixels.shape)
    rays = np.stack([WIDE.rays(p) for p in pixels])
    lines = np.stack([WIDE.line_times(p) for p in pixels])
    here = rng.uniform(size=lines.shape) > 0.1
    here[images // 2] = True
    plane = np.where(here[..., None], rays[..., :2] / rays[..., 2:], 0)
    return ClipTracks(plane, np.where(here, lines, 0), here, times)
