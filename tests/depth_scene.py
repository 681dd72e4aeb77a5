"""A small rendered scene for the depth tests: a slanted textured wall with a ball in front."""

from dataclasses import dataclass

import numpy as np
import torch

from geogs.depth.depth_view import DepthView, depth_images
from geogs.depth.plane_sweep import SweepResult
from geogs.depth.refinement import SlantedDepth
from geogs.geometry.camera import Camera

WORKING = Camera(fx=160.0, fy=160.0, cx=95.5, cy=71.5, width=192, height=144)
RENDER = WORKING.resized(96, 72)
_BALL, _RADIUS = np.array([0.1, 0.05, 2.0]), 0.4
_NORMAL, _OFFSET = np.array([-0.25, 0.1, 1.0]), 3.0
_CENTRES = [[0, 0, 0], [0.25, 0, 0], [-0.25, 0.05, 0], [0.02, 0.25, 0.05], [0.05, -0.25, 0]]


@dataclass(frozen=True)
class DepthScene:
    """Views of the scene and the true depth of each at the render size."""

    views: list[DepthView]
    truth: list[np.ndarray]


def make_scene(seed: int = 0, working: Camera = WORKING, render: Camera = RENDER) -> DepthScene:
    """Five views; the tracker is right to 3 % on most cells and knows nothing of every fourth."""
    rng = np.random.default_rng(seed)
    views, truth = [], []
    for i, centre in enumerate(_CENTRES):
        T_wc = np.eye(4)
        T_wc[:3, :3] = _turn(0.04 * np.array([centre[1], -centre[0], 0]))
        T_wc[:3, 3] = centre
        depth, points = trace(working, T_wc)
        image = _texture(points)
        grid = 1.0 / depth[4:-3:8, 4:-3:8]
        lost = rng.random(grid.shape) < 0.25
        noise = 0.03 * rng.standard_normal(grid.shape)
        inverse = np.where(lost, grid * rng.uniform(0.4, 2.0, grid.shape), grid * (1 + noise))
        information = np.where(lost, 1e-2, (1.0 / (0.15 * grid)) ** 2)
        grids = inverse.astype(np.float32), information.astype(np.float32)
        views.append(DepthView(i, np.linalg.inv(T_wc), *depth_images(image, render), image, *grids))
        truth.append(trace(render, T_wc)[0].astype(np.float32))
    return DepthScene(views, truth)


def trace(camera: Camera, T_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth (h, w) and world points (h, w, 3)."""
    rays = camera.rays(torch.float64).numpy() @ T_wc[:3, :3].T
    origin = T_wc[:3, 3]
    wall = (_OFFSET - _NORMAL @ origin) / (rays @ _NORMAL)
    b = rays @ (origin - _BALL)
    a = (rays * rays).sum(-1)
    discriminant = b * b - a * ((origin - _BALL) @ (origin - _BALL) - _RADIUS**2)
    ball = (-b - np.sqrt(np.maximum(discriminant, 0.0))) / a
    depth = np.where(discriminant > 0, np.minimum(ball, wall), wall)
    return depth, origin + depth[..., None] * rays


def _texture(points: np.ndarray) -> np.ndarray:
    """A solid texture: random waves of 3 to 25 per metre, another set for each colour."""
    rng = np.random.default_rng(7)
    image = np.empty(points.shape)
    on_ball = np.linalg.norm(points - _BALL, axis=-1) < _RADIUS + 1e-6
    for c in range(3):
        value = np.zeros(points.shape[:2])
        for _ in range(24):
            wave = rng.standard_normal(3)
            wave *= rng.uniform(3, 25) / np.linalg.norm(wave)
            value += np.sin(points @ wave + rng.uniform(0, 6.28))
        image[..., c] = 0.45 + 0.06 * value + 0.15 * on_ball * (1 - c)
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def _turn(axis_angle: np.ndarray) -> np.ndarray:
    """Rotation matrix of a small rotation vector."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(axis_angle).as_matrix()


FOREGROUND, WALL, FATTENED = np.float32(0.5), np.float32(0.4), 3
"""Inverse depths of two surfaces, and pixels by which the nearer seems wider than it is."""


def inside(height: int, width: int, beyond: int = 0) -> np.ndarray:
    """Pixels of a square in the middle of an image, and of so many beyond its sides."""
    y, x = np.mgrid[:height, :width]
    half = height // 4 + beyond
    return (np.abs(y - height // 2) <= half) & (np.abs(x - width // 2) <= half)


def fattened(height: int, width: int) -> tuple[SlantedDepth, np.ndarray, np.ndarray, SweepResult]:
    """A square before a slanted bare wall that a search has fattened, for ``resolve_edges``.

    Its confidence, the image's colours, and a sweep whose costs tell the square from the wall and
    nothing beside it.
    """
    rng = np.random.default_rng(5)
    square, halo = inside(height, width), inside(height, width, FATTENED)
    slope = np.float32(2e-4)
    wall = WALL + slope * np.arange(width, dtype=np.float32) * np.ones((height, 1), np.float32)
    rho = np.where(halo, FOREGROUND, wall) * (1 + 1e-3 * rng.standard_normal((height, width)))
    zero = np.zeros((height, width), np.float32)
    slope_x = np.where(halo, np.float32(0.0), slope).astype(np.float32)
    guide = np.where(square, 0.7, 0.3) + 0.02 * rng.standard_normal((3, height, width))
    planes = np.linspace(0.3, 0.6, 31, dtype=np.float32)
    away = np.abs(planes - np.where(square, FOREGROUND, wall)[..., None]) / 0.02
    costs = np.where((halo & ~square)[..., None], 0.6, np.minimum(away, 1.0)).astype(np.float32)
    confidence = rng.uniform(0.6, 0.95, (height, width)).astype(np.float32)
    refined = SlantedDepth(rho.astype(np.float32), slope_x, zero, zero + 5)
    sweep = SweepResult(rho.astype(np.float32), zero, zero, planes, costs)
    return refined, confidence, guide.astype(np.float32), sweep
