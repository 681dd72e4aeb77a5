"""Renders a scene: exact depth, normals and solids at the pixel centres, smooth colour."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from geogs.geometry.camera import Camera
from geogs.synth.lighting_kernels import visibility_slices
from geogs.synth.raycast_kernels import Lighting, Solids, Textures, cast_rows, shade_rows
from geogs.synth.scene import Scene, Texture

_LEVELS = 8
_VOXEL = 0.14
_AMBIENT_REACH = 0.7
_SPHERE_SAMPLES = 24
_SHADOW_MIN_HALF = 0.1
"""Solids smaller than this in every direction cast no shadow; they cost as much as large ones."""


@dataclass(frozen=True)
class View:
    """What a camera sees, exact at the pixel centres."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB, smoothed over the pixel."""
    depth: Float32[np.ndarray, "h w"]
    """z along the optical axis, metres; 0 where nothing is hit."""
    normal: Float32[np.ndarray, "h w 3"]
    """Unit, camera frame, facing the camera; zero where nothing is hit."""
    solid: Int64[np.ndarray, "h w"]
    """Index of the solid, -1 where nothing is hit."""


class Raycaster:
    """Renders one scene from any number of cameras; textures and lighting are prepared once."""

    def __init__(self, scene: Scene, threads: int = 2) -> None:
        self.scene = scene
        self._pool = ThreadPoolExecutor(threads)
        self._threads = threads
        self._textures = _pack_textures(scene.textures)
        self._lighting = self._compute_lighting()

    def render(self, camera: Camera, T_wc: Float64[np.ndarray, "4 4"]) -> View:
        """What a camera with pose camera-to-world ``T_wc`` sees.

        Depth, normal and solid are those of the ray through the pixel's centre; the colour is the
        mean over the pixel.
        """
        shape = (camera.height, camera.width)
        depth = np.full(shape, np.inf)
        solid = np.full(shape, -1, np.int64)
        face = np.zeros(shape, np.int64)
        image = np.zeros((*shape, 3), np.float32)
        normal = np.zeros((*shape, 3), np.float32)
        xs = (np.arange(camera.width) - camera.cx) / camera.fx
        ys = (np.arange(camera.height) - camera.cy) / camera.fy
        solids = self._solids_from(T_wc)
        bounds = _pixel_bounds(self.scene, camera, T_wc)

        def cast(first: int, last: int) -> None:
            cast_rows(solids, bounds, xs, ys, first, last, depth, solid, face)

        def shade(first: int, last: int) -> None:
            shade_rows(
                solids, self._textures, self._lighting, T_wc, xs, ys, first, last,
                depth, solid, face, image, normal,
            )  # fmt: skip

        self._in_bands(camera.height, cast)
        self._in_bands(camera.height, shade)
        depth[solid < 0] = 0.0
        return View(np.rint(image).astype(np.uint8), depth.astype(np.float32), normal, solid)

    def _in_bands(self, rows: int, work: Callable[[int, int], None]) -> None:
        """Runs ``work(first, last)`` over bands of rows, several per thread to even the load."""
        edges = np.linspace(0, rows, 4 * self._threads + 1).astype(int).tolist()
        list(self._pool.map(work, edges[:-1], edges[1:]))

    def _solids_from(self, T_wc: Float64[np.ndarray, "4 4"]) -> Solids:
        s = self.scene
        to_local = s.rotation.transpose(0, 2, 1)
        return Solids(
            kind=s.kind,
            half=s.half,
            rotation=s.rotation,
            origin=np.einsum("nij,nj->ni", to_local, T_wc[:3, 3] - s.centre),
            matrix=to_local @ T_wc[:3, :3],
            texture=s.face_texture,
            shift=s.texture_shift,
            emission=s.emission,
        )

    def _compute_lighting(self) -> Lighting:
        s = self.scene
        casts = (s.bounding_half.max(1) > _SHADOW_MIN_HALF) & (s.emission == 0)
        lights = np.array([(*light.position, light.radius) for light in s.lights]).reshape(-1, 4)
        colour = np.array([light.colour for light in s.lights]).reshape(-1, 3)
        nx, ny, nz = np.ceil(s.size / _VOXEL).astype(int)
        volume = np.zeros((nz, ny, nx, 1 + len(lights)), np.float32)
        radius = np.linalg.norm(s.bounding_half[casts], axis=1)
        solids = s.kind[casts], s.half[casts], s.rotation[casts], s.centre[casts], radius
        sphere = _fibonacci_sphere(_SPHERE_SAMPLES)

        def fill(first: int, last: int) -> None:
            visibility_slices(*solids, lights, sphere, _AMBIENT_REACH, _VOXEL, first, last, volume)

        self._in_bands(int(nz), fill)
        return Lighting(
            volume=volume,
            voxel=_VOXEL,
            position=lights[:, :3].copy(),
            colour=colour,
            above=np.array([0.30, 0.31, 0.33]),
            below=np.array([0.24, 0.21, 0.18]),
        )


def _fibonacci_sphere(n: int) -> Float64[np.ndarray, "n 3"]:
    """Evenly spread directions (Fibonacci lattice)."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.arange(n) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def _pixel_bounds(
    scene: Scene, camera: Camera, T_wc: Float64[np.ndarray, "4 4"]
) -> Int64[np.ndarray, "n 4"]:
    """Left, top, right, bottom (exclusive) of the pixels that may see each solid."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    corners = scene.bounding_half[:, None] * signs
    world = np.einsum("nij,nkj->nki", scene.rotation, corners) + scene.centre[:, None]
    x, y, z = np.moveaxis((world - T_wc[:3, 3]) @ T_wc[:3, :3], -1, 0)
    near = z < 1e-3
    safe = np.where(near, 1.0, z)
    u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    limit = np.array([camera.width, camera.height, camera.width, camera.height])
    box = np.stack([u.min(1), v.min(1), u.max(1) + 1, v.max(1) + 1], 1)
    box = np.clip(np.concatenate([np.ceil(box[:, :2]), np.floor(box[:, 2:])], 1), 0, limit)
    # A solid that crosses the camera's plane may be anywhere that no side of the view excludes.
    box[near.any(1)] = [0, 0, camera.width, camera.height]
    left, right = -(camera.cx + 1) / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = -(camera.cy + 1) / camera.fy, (camera.height - camera.cy) / camera.fy
    for beyond in (near, x < left * z, x > right * z, y < top * z, y > bottom * z):
        box[beyond.all(1)] = 0
    return box.astype(np.int64)


def _pack_textures(textures: tuple[Texture, ...]) -> Textures:
    """All textures and their pyramids (area averages) in one flat array."""
    pieces: list[np.ndarray] = []
    table = np.zeros((3, len(textures), _LEVELS), np.int64)
    end = 0
    for i, texture in enumerate(textures):
        image = np.ascontiguousarray(texture.image)
        for level in range(_LEVELS):
            h, w = image.shape[:2]
            table[:, i, level] = end, w, h
            pieces.append(image.ravel())
            end += image.size
            half = (max(1, w // 2), max(1, h // 2))
            image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    texel = np.array([t.metres_per_texel for t in textures])
    return Textures(np.concatenate(pieces), table[0], table[1], table[2], texel)
