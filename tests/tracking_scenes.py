"""A small textured room of planes, rendered exactly: images, depth and poses for tracker tests."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.types import Frame

CAMERA = Camera(fx=150.0, fy=150.0, cx=95.5, cy=71.5, width=192, height=144)

# Planes n . x = c of a box around the origin, with a slanted slab in it (metres).
PLANES = [
    ((0.0, 0.0, 1.0), 3.0),
    ((0.0, 1.0, 0.0), 1.2),
    ((0.0, -1.0, 0.0), 1.2),
    ((1.0, 0.0, 0.0), 2.0),
    ((-1.0, 0.0, 0.0), 2.0),
    ((0.3, 0.0, 1.0), 2.4),
]


def _texture(seed: int, size: int = 512) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size), np.float32)
    for octave in (8, 16, 32, 64, 128):
        noise = rng.random((octave, octave)).astype(np.float32)
        image += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC) / 5
    low, high = np.quantile(image, [0.02, 0.98])
    return np.clip((image - low) / (high - low), 0, 1) * 200 + 25


TEXTURES = [_texture(k) for k in range(len(PLANES))]


def render(T_wc: np.ndarray, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """Grey RGB image and z-depth from a camera at T_wc inside the box."""
    room = (*PLANES, *map(id, TEXTURES))
    image, depth = _rendered(T_wc.astype(np.float64).tobytes(), camera, room)
    return image.copy(), depth.copy()


@lru_cache(maxsize=256)
def _rendered(T_wc: bytes, camera: Camera, room: tuple) -> tuple[np.ndarray, np.ndarray]:
    """The same, kept as many tests look from the same poses; ``room`` tells it from another."""
    T, rays = np.frombuffer(T_wc).reshape(4, 4), camera.rays(torch.float64).numpy()
    return seen(T[:3, 3], rays @ T[:3, :3].T)


def seen(centre: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey RGB image and depth along (h, w, 3) directions from one centre, or from each row's."""
    depth = np.full(directions.shape[:2], np.inf)
    image = np.zeros(directions.shape[:2], np.float32)
    for k, (normal, offset) in enumerate(PLANES):
        n = np.array(normal)
        with np.errstate(divide="ignore"):
            z = (offset - centre @ n) / (directions @ n)
        points = centre + z[..., None] * directions
        near = (z > 0) & (z < depth)
        if k == len(PLANES) - 1:
            near &= (np.abs(points[..., 0]) < 0.7) & (np.abs(points[..., 1]) < 0.6)
        axes = np.argsort(np.abs(n))[:2]
        uv = np.mod(points[..., axes] * 110.0, 511.0).astype(np.float32)
        colour = cv2.remap(TEXTURES[k], uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)
        image = np.where(near, colour, image)
        depth = np.where(near, z, depth)
    grey = np.clip(image, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, -1), depth


@dataclass(frozen=True, eq=False)
class ExactDepth:
    """True depth as a sensor would bring it, by which a map is started at its first frame."""

    depth: np.ndarray

    def metres(self) -> np.ndarray:
        return self.depth.astype(np.float32)


def pose(x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Camera at (x, y, z) metres, turned about the vertical by yaw radians."""
    T = np.eye(4)
    c, s = np.cos(yaw), np.sin(yaw)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = x, y, z
    return T


def sideways(count: int, step: float = 0.025) -> list[np.ndarray]:
    """A path that moves sideways, swings and turns a little."""
    return [
        pose(
            -0.5 + step * k, 0.05 * np.sin(0.3 * k), 0.1 * np.sin(0.11 * k), 0.1 * np.sin(0.13 * k)
        )
        for k in range(count)
    ]


def frames(poses: list[np.ndarray]) -> list[Frame]:
    """Rendered frames at 30 per second."""
    return [Frame(k, k / 30, render(T)[0]) for k, T in enumerate(poses)]
