"""Renders a scene: exact depth, normals and solids at the pixel centres, smooth colour."""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from geogs.geometry.camera import Camera
from geogs_synth.camera.radial_camera import RadialCamera
from geogs_synth.raycast.pixel_kernels import (
    Lighting,
    PlacedSolids,
    Textures,
    Traced,
    cast_rows,
    shade_rows,
)
from geogs_synth.raycast.solid_kernels import BoundedSolids, visibility_slices
from geogs_synth.scene.bodies import Body
from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.scene.light_changes import LightChanges
from geogs_synth.scene.textured_scene import Scene, Texture, joined

_LEVELS = 8
_VOXEL = 0.14
_MAX_CELLS = 60_000
"""Most cells of the light volume; larger scenes have larger cells."""
_AMBIENT_REACH = 0.7
"""Metres over which solids darken the ambient light where cells have the smallest size."""
_SHADOW_MIN_HALF = 0.1
"""Metres; solids smaller than this in every direction cast no shadow where cells have the smallest
size, since they cost as much as large ones."""
_ROWS_PLACED = 8
"""Rows of a rolling shutter between which solids move straight over the image."""


@dataclass(frozen=True)
class RenderedView:
    """A rendered image with its truth, exact at the pixel centres."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB, smoothed over the pixel."""
    depth: Float32[np.ndarray, "h w"]
    """z along the optical axis, metres; 0 where nothing is hit."""
    normal: Float32[np.ndarray, "h w 3"]
    """Unit, camera frame, facing the camera; zero where nothing is hit."""
    solid: Int64[np.ndarray, "h w"]
    """Index of the solid, -1 where nothing is hit; bodies come after the solids of the scene."""
    shade: Float32[np.ndarray, "h w 3"]
    """The image before rounding; its square is proportional to the light."""


@dataclass(frozen=True)
class PlacedScene:
    """The n solids of a scene before p cameras."""

    scene: Scene
    T_wc: Float64[np.ndarray, "p 4 4"]
    rotation: Float64[np.ndarray, "p n 3 3"]
    """Local to world."""
    centre: Float64[np.ndarray, "p n 3"]

    def solids(self, camera: int) -> PlacedSolids:
        """All solids for one of the cameras."""
        s = self.scene
        return PlacedSolids(
            kind=s.solids.kind,
            half=s.solids.half,
            rotation=self.rotation[camera],
            origin=self._origin[camera],
            matrix=self._matrix[camera],
            texture=s.face_texture,
            shift=s.texture_shift,
            emission=s.emission,
        )

    def bounds(
        self, lens: RadialCamera, cameras: list[int], margin: float = 0.0
    ) -> Int64[np.ndarray, "k n 4"]:
        """Left, top, right, bottom (exclusive) of the pixels that may see each solid."""
        T_wc = self.T_wc[cameras]
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        corners = self.scene.solids.bounding_half[:, None] * signs
        world = np.einsum("pnij,nkj->pnki", self.rotation[cameras], corners)
        world += self.centre[cameras][:, :, None]
        local = (world - T_wc[:, None, None, :3, 3]) @ T_wc[:, None, :3, :3]
        x, y, z = np.moveaxis(local, -1, 0)
        near = z < 1e-3
        plane = local[..., :2] / np.where(near, 1.0, z)[..., None]
        box = lens.pixel_boxes(plane.min(2), plane.max(2), margin)
        # A solid that crosses the camera's plane may be in any pixel, unless a side excludes it.
        box[near.any(2)] = [0, 0, lens.camera.width, lens.camera.height]
        left, top, right, bottom = lens.view
        for beyond in (near, x < left * z, x > right * z, y < top * z, y > bottom * z):
            box[beyond.all(2)] = 0
        return box

    @cached_property
    def _origin(self) -> Float64[np.ndarray, "p n 3"]:
        offset = self.T_wc[:, None, :3, 3] - self.centre
        return np.einsum("pnji,pnj->pni", self.rotation, offset)

    @cached_property
    def _matrix(self) -> Float64[np.ndarray, "p n 3 3"]:
        return self.rotation.swapaxes(2, 3) @ self.T_wc[:, None, :3, :3]


class Raycaster:
    """Renders one scene from any number of cameras; textures and lighting are prepared once.

    Moving bodies are lit as everything else, but cast no shadow.
    """

    def __init__(self, scene: Scene, threads: int = 2) -> None:
        self.scene = scene
        self._pool = ThreadPoolExecutor(threads)
        self._threads = threads
        self._lightings: tuple[Lighting, ...] = (self._compute_lighting(),)
        self._switched_at = np.zeros(0)
        self._use(())

    def with_bodies(self, bodies: Sequence[Body]) -> "Raycaster":
        """The same scene with other bodies; the prepared data is shared."""
        other = copy.copy(self)
        other._use(bodies)
        return other

    def with_lights(self, changes: LightChanges) -> "Raycaster":
        """The same scene with lights that change over time; the prepared data is shared."""
        other = copy.copy(self)
        steady = self._lightings[0]
        other._lightings = tuple(
            steady._replace(colour=steady.colour * gains[:, None]) for gains in changes.gains
        )
        other._switched_at = changes.times
        return other

    def _lighting_at(self, time: float) -> Lighting:
        return self._lightings[int(np.searchsorted(self._switched_at, time, side="right"))]

    def bodies(self) -> Iterator[tuple[int, Body]]:
        """Each body with the index of its first solid in a view."""
        first = len(self.scene)
        for body in self._bodies:
            yield first, body
            first += len(body.shape)

    def _use(self, bodies: Sequence[Body]) -> None:
        self._bodies = tuple(bodies)
        shapes = [body.shape for body in bodies]
        self._sky: int | None = None
        if self.scene.sky is not None:
            self._sky = len(self.scene) + sum(map(len, shapes))
            shapes.append(_dome(self.scene))
        self._all = joined(self.scene, *shapes) if shapes else self.scene
        self._textures = _pack_textures(self._all.textures)

    def render(
        self, camera: Camera | RadialCamera, T_wc: Float64[np.ndarray, "4 4"], time: float = 0.0
    ) -> RenderedView:
        """Render a camera with pose camera-to-world ``T_wc``, all rows at once.

        Depth, normal and solid are those of the ray through the pixel's centre; the colour is the
        mean over the pixel. ``time`` in seconds determines the bodies' poses and the light.
        """
        lens = RadialCamera.of(camera)
        placed = self._place(T_wc[None], np.array([time]))
        solids = placed.solids(0)
        bounds = placed.bounds(lens, [0])[0]
        traced = _untraced(lens.camera.height, lens.camera.width)
        xs, ys = lens.rays
        lighting = self._lighting_at(time)

        def cast(first: int, last: int) -> None:
            cast_rows(solids, bounds, xs, ys, first, last, traced)

        def shade(first: int, last: int) -> None:
            shade_rows(
                solids, self._textures, lighting, T_wc, lens.pixel, xs, ys, first, last, traced
            )

        self._in_bands(lens.camera.height, cast)
        self._in_bands(lens.camera.height, shade)
        return self._view(traced)

    def render_rolling(
        self,
        lens: RadialCamera,
        T_wc: Float64[np.ndarray, "h 4 4"],
        times: Float64[np.ndarray, "h"],
    ) -> RenderedView:
        """Render a camera whose row v is taken from the pose ``T_wc[v]`` at ``times[v]``.

        Row v is that of :meth:`render` at this pose and time.
        """
        height = lens.camera.height
        traced = _untraced(height, lens.camera.width)
        xs, ys = lens.rays

        def work(first: int, last: int) -> None:
            placed = self._place(T_wc[first:last], times[first:last])
            ends = placed.bounds(lens, [0, -1], margin=1.0)
            # Over a few rows the corners of a solid move straight.
            bounds = np.concatenate([ends[..., :2].min(0), ends[..., 2:].max(0)], 1)
            for row in range(first, last):
                low, high = max(row - 1, 0), min(row + 2, height)
                # The rows above and below, seen from this row's pose, show where edges are.
                around = _untraced(high - low, lens.camera.width)
                near = bounds - [0, low, 0, low]
                rays = xs[low:high], ys[low:high]
                solids = placed.solids(row - first)
                cast_rows(solids, near, *rays, 0, high - low, around)
                lighting = self._lighting_at(times[row])
                own = row - low
                shade_rows(
                    solids,
                    self._textures,
                    lighting,
                    T_wc[row],
                    lens.pixel,
                    *rays,
                    own,
                    own + 1,
                    around,
                )
                for whole, part in zip(traced, around, strict=True):
                    whole[row] = part[own]

        edges = [*range(0, height, _ROWS_PLACED), height]
        list(self._pool.map(work, edges[:-1], edges[1:]))
        return self._view(traced)

    def _view(self, traced: Traced) -> RenderedView:
        depth = traced.depth
        solid = traced.solid
        if self._sky is not None:
            solid[solid == self._sky] = -1
            traced.normal[solid < 0] = 0.0
        depth[solid < 0] = 0.0
        image = np.rint(traced.image).astype(np.uint8)
        return RenderedView(image, depth.astype(np.float32), traced.normal, solid, traced.image)

    def _in_bands(self, rows: int, work: Callable[[int, int], None]) -> None:
        """Runs ``work(first, last)`` over bands of rows, several per thread to even the load."""
        edges = np.linspace(0, rows, 4 * self._threads + 1).astype(int).tolist()
        list(self._pool.map(work, edges[:-1], edges[1:]))

    def _place(
        self, T_wc: Float64[np.ndarray, "p 4 4"], times: Float64[np.ndarray, "p"]
    ) -> PlacedScene:
        """Poses of all solids for p cameras at p times."""
        rotation = np.repeat(self._all.solids.rotation[None], len(times), 0)
        centre = np.repeat(self._all.solids.centre[None], len(times), 0)
        for first, body in self.bodies():
            T_wb = body.path(times)
            own = slice(first, first + len(body.shape))
            rotation[:, own] = T_wb[:, None, :3, :3] @ body.shape.solids.rotation
            centre[:, own] = body.shape.solids.centre @ T_wb[:, :3, :3].transpose(0, 2, 1)
            centre[:, own] += T_wb[:, None, :3, 3]
        return PlacedScene(self._all, T_wc, rotation, centre)

    def _compute_lighting(self) -> Lighting:
        s = self.scene
        coarser = max(1.0, float(np.cbrt(s.size.prod() / _MAX_CELLS)) / _VOXEL)
        voxel = coarser * _VOXEL
        reach = coarser * _AMBIENT_REACH
        large = s.solids.bounding_half.max(1) > coarser * _SHADOW_MIN_HALF
        opaque = s.solids.at(large & (s.emission == 0))
        lights = np.array([(*light.position, light.radius) for light in s.lights]).reshape(-1, 4)
        colour = np.array([light.colour for light in s.lights]).reshape(-1, 3)
        nx, ny, nz = np.ceil(s.size / voxel).astype(int)
        volume = np.zeros((nz, ny, nx, 1 + len(lights)), np.float32)
        radius = np.linalg.norm(opaque.bounding_half, axis=1)
        solids = BoundedSolids(opaque.kind, opaque.half, opaque.rotation, opaque.centre, radius)
        sphere = _fibonacci_sphere(24)

        def fill(first: int, last: int) -> None:
            visibility_slices(solids, lights, sphere, reach, voxel, first, last, volume)

        self._in_bands(int(nz), fill)
        return Lighting(
            volume=volume,
            voxel=voxel,
            position=lights[:, :3].copy(),
            colour=colour,
            above=np.array([0.30, 0.31, 0.33]),
            below=np.array([0.24, 0.21, 0.18]),
        )


def _untraced(height: int, width: int) -> Traced:
    """Arrays for the kernels to fill: nothing is hit yet."""
    shape = (height, width)
    return Traced(
        depth=np.full(shape, np.inf),
        solid=np.full(shape, -1, np.int64),
        face=np.zeros(shape, np.int64),
        image=np.zeros((*shape, 3), np.float32),
        normal=np.zeros((*shape, 3), np.float32),
    )


def _dome(scene: Scene) -> Scene:
    """The sky as a shining ball around everything."""
    assert scene.sky is not None
    build = SceneBuilder(np.random.default_rng(0))
    texture = build.texture(scene.sky.image)
    radii = np.full(3, 1e5)  # farther than anything else
    build.ellipsoid(scene.size / 2, radii, texture, emission=0.95)
    return build.build(scene.size)


def _fibonacci_sphere(n: int) -> Float64[np.ndarray, "n 3"]:
    """Evenly spread directions (Fibonacci lattice)."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.arange(n) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


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
