"""The surface of a scene as triangles and as the points that a camera has seen."""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int32

from geogs.geometry.camera import Camera
from geogs_synth.camera.radial_camera import RadialCamera
from geogs_synth.scene.solids import BOX, FRUSTUM
from geogs_synth.scene.textured_scene import Scene

_TOLERANCE = 4e-4
"""Largest distance in metres between a chord and the arc it replaces."""


def scene_mesh(scene: Scene) -> tuple[Float64[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """Vertices (world, metres) and triangles, counter-clockwise from outside.

    Boxes are exact; round solids are inscribed and deviate by less than 1 mm. Surfaces hidden
    inside other solids are kept.
    """
    vertices, triangles, count = [], [], 0
    s = scene.solids
    for kind, rotation, centre, half in zip(s.kind, s.rotation, s.centre, s.half, strict=True):
        if kind == BOX:
            points, faces = _box(half)
        elif kind == FRUSTUM:
            points, faces = _frustum(half)
        else:
            points, faces = _ellipsoid(half)
        vertices.append(points @ rotation.T + centre)
        triangles.append(faces + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(triangles).astype(np.int32)


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    quads = np.array(
        [[4, 5, 7, 6], [0, 2, 3, 1], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    )
    if half[2] == 0:
        corners, quads = corners[4:], quads[:1] - 4
    return corners * half, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _segments(radius: float) -> int:
    """Sides of the polygon whose chords stay within the tolerance of the circle."""
    return max(12, math.ceil(math.pi / math.acos(1 - min(1.0, _TOLERANCE / radius))))


def _frustum(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n = _segments(max(half[0], half[1]))
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1)
    down, up = [0, 0, -half[2]], [0, 0, half[2]]
    points = np.concatenate([half[0] * ring + down, half[1] * ring + up, [down, up]])
    a, b = np.arange(n), (np.arange(n) + 1) % n
    side = np.concatenate([np.stack([a, b, b + n], 1), np.stack([a, b + n, a + n], 1)])
    low = np.stack([b, a, np.full(n, 2 * n)], 1)
    high = np.stack([a + n, b + n, np.full(n, 2 * n + 1)], 1)
    return points, np.concatenate([side, low, high])


def _ellipsoid(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n = _segments(float(half.max()))
    rings = n // 2 + 1
    latitude, longitude = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(n) / n
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")
    grid = np.stack([np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat)], -1)
    points = np.concatenate([grid.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]]) * half
    row, column = np.meshgrid(np.arange(rings - 2), np.arange(n), indexing="ij")
    a, b = (row * n + column).ravel(), (row * n + (column + 1) % n).ravel()
    body = np.concatenate([np.stack([a, a + n, b + n], 1), np.stack([a, b + n, b], 1)])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    end = (rings - 2) * n
    top = np.stack([np.full(n, end + n), i, j], 1)
    bottom = np.stack([np.full(n, end + n + 1), end + j, end + i], 1)
    return points, np.concatenate([body, top, bottom])


class SeenSurface:
    """The surface points in the depth maps of one camera, one to a voxel."""

    def __init__(self, scene: Scene, camera: Camera | RadialCamera, voxel: float = 0.01) -> None:
        x, y = RadialCamera.of(camera).rays
        self._rays = np.stack([x, y, np.ones_like(x)], -1)
        self._voxel = voxel
        # A cell of margin, since walls lie exactly on the border.
        self._shape = np.ceil(scene.size / voxel).astype(np.int64) + 2
        self._filled = np.zeros(int(self._shape.prod()), bool)
        self._points: list[Float32[np.ndarray, "k 3"]] = []

    def add(self, depth: Float32[np.ndarray, "h w"], T_wc: Float64[np.ndarray, "4 4"]) -> None:
        """Add the back-projected pixels that fall into voxels of the scene empty so far."""
        seen = depth > 0
        points = (depth[..., None] * self._rays)[seen] @ T_wc[:3, :3].T + T_wc[:3, 3]
        cell = (points / self._voxel).astype(np.int32) + 1
        inside = ((cell >= 0) & (cell < self._shape)).all(1)
        if not inside.all():
            points, cell = points[inside], cell[inside]
        x, y, z = cell.T
        key = (z * self._shape[1] + y) * self._shape[0] + x
        fresh = np.flatnonzero(~self._filled[key])
        key, first = np.unique(key[fresh], return_index=True)
        self._filled[key] = True
        self._points.append(points[fresh[first]].astype(np.float32))

    @property
    def points(self) -> Float32[np.ndarray, "n 3"]:
        """World points in metres."""
        return np.concatenate([np.empty((0, 3), np.float32), *self._points])
