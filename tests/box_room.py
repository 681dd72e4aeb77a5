"""A box seen from inside by a camera on a circle."""

import numpy as np

from geogs.geometry.camera import Camera

CAMERA = Camera(fx=80.0, fy=80.0, cx=63.5, cy=47.5, width=128, height=96)


def box(half: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A closed box around the origin, faces turned inwards."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [f for a, b, c, d in quads for f in ((a, c, b), (a, d, c))]
    return corners * half, np.array(faces)


def circle(n: int = 60) -> np.ndarray:
    """Camera to world on a circle of 0.5 m, level (world z is up), looking outwards."""
    T = np.tile(np.eye(4), (n, 1, 1))
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, n, endpoint=False)):
        forward = np.array([np.cos(angle), np.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        T[k, :3, :3] = np.stack([np.cross(down, forward), down, forward], -1)
        T[k, :3, 3] = 0.5 * forward + [0, 0, 0.1 * np.sin(3 * angle)]
    return T
