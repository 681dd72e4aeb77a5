"""A room or a street of a sequence: textured solids, lights, a sky.

Faces are numbered 0..5 for -x, +x, -y, +y, -z, +z of a solid's local frame; the round side of a
frustum and the whole ellipsoid are face 0.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int32, Int64, UInt8

from geogs_synth.scene.solids import BOX, FRUSTUM, Solids

_TOLERANCE = 4e-4
"""Largest distance in metres between a chord and the arc it replaces."""


@dataclass(frozen=True)
class Texture:
    """An image laid on surfaces."""

    image: UInt8[np.ndarray, "h w 3"]
    metres_per_texel: float
    """0 stretches the image over the face; otherwise it repeats at this scale."""


@dataclass(frozen=True)
class Light:
    """A small ball that gives light and is itself invisible."""

    position: tuple[float, float, float]
    colour: tuple[float, float, float]
    """Intensity per channel: irradiance at one metre."""
    radius: float
    """Metres; a larger ball casts softer shadows."""


@dataclass(frozen=True)
class Scene:
    """A room or a street full of n solids."""

    size: Float64[np.ndarray, "3"]
    solids: Solids[np.ndarray]
    face_texture: Int64[np.ndarray, "n 6"]
    """Index into ``textures`` for each face."""
    texture_shift: Float64[np.ndarray, "n 2"]
    """Metres by which repeating textures are shifted, so that no two solids look the same."""
    emission: Float64[np.ndarray, "n"]
    """Gain with which a surface glows in any light, if positive; it then casts no shadow."""
    textures: tuple[Texture, ...]
    lights: tuple[Light, ...]
    sky: Texture | None = None
    """Texture of the infinitely far sky by longitude and latitude; none in a closed room."""

    def __len__(self) -> int:
        return len(self.emission)

    def clearance(self, points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m"]:
        """Distance in metres from each point to the nearest solid, taken as its bounding box.

        Exact for boxes, a lower bound for round solids; zero inside a box.
        """
        s = self.solids
        nearest = np.full(len(points), np.inf)
        for rotation, centre, extent in zip(s.rotation, s.centre, s.bounding_half, strict=True):
            outside = np.maximum(np.abs((points - centre) @ rotation) - extent, 0.0)
            nearest = np.minimum(nearest, np.linalg.norm(outside, axis=1))
        return nearest


def joined(first: Scene, *others: Scene) -> Scene:
    """The solids of several scenes one after the other; the rest is that of the first."""
    scenes = (first, *others)
    ends = np.cumsum([0, *(len(scene.textures) for scene in scenes)])
    faces = [scene.face_texture + end for scene, end in zip(scenes, ends[:-1], strict=True)]
    return replace(
        first,
        solids=Solids.join([scene.solids for scene in scenes]),
        face_texture=np.concatenate(faces),
        texture_shift=np.concatenate([scene.texture_shift for scene in scenes]),
        emission=np.concatenate([scene.emission for scene in scenes]),
        textures=tuple(texture for scene in scenes for texture in scene.textures),
    )


def scene_mesh(scene: Scene) -> tuple[Float64[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """Vertices (world, metres) and triangles, counter-clockwise from outside.

    Boxes are exact; round solids are inscribed and deviate by less than 1 mm. Surfaces hidden
    inside other solids are kept.
    """
    vertices = []
    triangles = []
    count = 0
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
        corners = corners[4:]
        quads = quads[:1] - 4
    return corners * half, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _segments(radius: float) -> int:
    """Sides of the polygon whose chords stay within the tolerance of the circle."""
    return max(12, math.ceil(math.pi / math.acos(1 - min(1.0, _TOLERANCE / radius))))


def _frustum(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n = _segments(max(half[0], half[1]))
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1)
    down = [0, 0, -half[2]]
    up = [0, 0, half[2]]
    points = np.concatenate([half[0] * ring + down, half[1] * ring + up, [down, up]])
    a, b = np.arange(n), (np.arange(n) + 1) % n
    side = np.concatenate([np.stack([a, b, b + n], 1), np.stack([a, b + n, a + n], 1)])
    low = np.stack([b, a, np.full(n, 2 * n)], 1)
    high = np.stack([a + n, b + n, np.full(n, 2 * n + 1)], 1)
    return points, np.concatenate([side, low, high])


def _ellipsoid(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n = _segments(float(half.max()))
    rings = n // 2 + 1
    latitude = np.pi * np.arange(1, rings) / rings
    longitude = 2 * np.pi * np.arange(n) / n
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
