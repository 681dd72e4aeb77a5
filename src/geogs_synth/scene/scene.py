"""What a synthetic scene is made of: boxes, cone frustums and ellipsoids with textures and lights.

World frame: z up, metres, the scene fills [0, size]. A solid has a local frame (rotation local to
world, centre) and three numbers ``half`` whose meaning depends on its kind:

- BOX: half extents; a zero half extent along z makes a rectangle,
- FRUSTUM: radius at -z, radius at +z, half height (equal radii make a cylinder),
- ELLIPSOID: the three radii.

Faces are numbered 0..5 for -x, +x, -y, +y, -z, +z of the local frame; the round side of a frustum
and the whole ellipsoid are face 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64, UInt8

BOX, FRUSTUM, ELLIPSOID = 0, 1, 2

Number = float | int
Triple = Sequence[Number] | Float64[np.ndarray, "3"]
Pair = tuple[Number, Number]


@dataclass(frozen=True)
class Texture:
    """An image laid on surfaces."""

    image: UInt8[np.ndarray, "h w 3"]
    metres_per_texel: float
    """0 stretches the image over the face; otherwise it repeats at this scale."""


@dataclass(frozen=True)
class Light:
    """A small ball that gives light and is itself not seen."""

    position: tuple[float, float, float]
    colour: tuple[float, float, float]
    """Intensity per channel: irradiance at one metre."""
    radius: float
    """Of the ball; larger casts softer shadows."""


@dataclass(frozen=True)
class Scene:
    """A room or a street full of solids, as arrays over its n solids."""

    size: Float64[np.ndarray, "3"]
    kind: Int64[np.ndarray, "n"]
    rotation: Float64[np.ndarray, "n 3 3"]
    """Local to world."""
    centre: Float64[np.ndarray, "n 3"]
    half: Float64[np.ndarray, "n 3"]
    face_texture: Int64[np.ndarray, "n 6"]
    """Index into ``textures`` for each face."""
    texture_shift: Float64[np.ndarray, "n 2"]
    """Metres by which repeating textures are shifted, so that no two solids look the same."""
    emission: Float64[np.ndarray, "n"]
    """Positive: the surface glows with this gain in any light, and casts no shadow."""
    textures: tuple[Texture, ...]
    lights: tuple[Light, ...]
    sky: Texture | None = None
    """Longitude and latitude of what is infinitely far; none in a closed room."""

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def bounding_half(self) -> Float64[np.ndarray, "n 3"]:
        """Half extents of each solid's bounding box in its local frame."""
        radius = self.half[:, :2].max(1)
        frustum = np.stack([radius, radius, self.half[:, 2]], 1)
        return np.where((self.kind == FRUSTUM)[:, None], frustum, self.half)

    def clearance(self, points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m"]:
        """Distance in metres from each point to the nearest solid, taken as its bounding box.

        Exact for boxes, a lower bound for round solids; zero inside a box.
        """
        half = self.bounding_half
        nearest = np.full(len(points), np.inf)
        for rotation, centre, extent in zip(self.rotation, self.centre, half, strict=True):
            outside = np.maximum(np.abs((points - centre) @ rotation) - extent, 0.0)
            nearest = np.minimum(nearest, np.linalg.norm(outside, axis=1))
        return nearest


def joined(first: Scene, *others: Scene) -> Scene:
    """The solids of several scenes one after the other; the rest is that of the first."""
    scenes = (first, *others)
    ends = np.cumsum([0, *(len(scene.textures) for scene in scenes)])

    def stacked(name: str) -> np.ndarray:
        return np.concatenate([getattr(scene, name) for scene in scenes])

    faces = [scene.face_texture + end for scene, end in zip(scenes, ends[:-1], strict=True)]
    return replace(
        first,
        kind=stacked("kind"),
        rotation=stacked("rotation"),
        centre=stacked("centre"),
        half=stacked("half"),
        face_texture=np.concatenate(faces),
        texture_shift=stacked("texture_shift"),
        emission=stacked("emission"),
        textures=tuple(texture for scene in scenes for texture in scene.textures),
    )


def yaw_rotation(yaw: Number) -> Float64[np.ndarray, "3 3"]:
    """Rotation by ``yaw`` radians about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass
class _Parts:
    """The growing lists behind a builder and the builders it places."""

    kind: list[int]
    rotation: list[np.ndarray]
    centre: list[np.ndarray]
    half: list[np.ndarray]
    face_texture: list[list[int]]
    texture_shift: list[np.ndarray]
    emission: list[float]
    textures: list[Texture]
    lights: list[Light]


class SceneBuilder:
    """Collects solids given in a local frame; ``at`` opens a frame inside this one.

    The frames of furniture have x to the right along the wall behind it, y into the room, z up.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._parts = _Parts([], [], [], [], [], [], [], [], [])
        self._rng = rng
        self._rotation = np.eye(3)
        self._origin = np.zeros(3)

    def at(self, x: Number, y: Number, z: Number = 0.0, yaw: Number = 0.0) -> "SceneBuilder":
        """A builder for a frame placed in this one; what it adds lands in the same scene."""
        child = SceneBuilder(self._rng)
        child._parts = self._parts
        child._rotation = self._rotation @ yaw_rotation(yaw)
        child._origin = self._origin + self._rotation @ np.array([x, y, z])
        return child

    def texture(self, image: UInt8[np.ndarray, "h w 3"], metres_per_texel: float = 0.0) -> int:
        """Registers a texture and returns its index; without a scale it is stretched over faces."""
        self._parts.textures.append(Texture(image, metres_per_texel))
        return len(self._parts.textures) - 1

    def light(self, position: Triple, colour: tuple[float, float, float], radius: float) -> None:
        """Adds a light at a position of this frame."""
        x, y, z = self._origin + self._rotation @ np.asarray(position, float)
        self._parts.lights.append(Light((float(x), float(y), float(z)), colour, radius))

    def box(
        self,
        centre: Triple,
        size: Triple,
        texture: int,
        *,
        rotation: np.ndarray | None = None,
        front: int | None = None,
        emission: Number = 0.0,
    ) -> None:
        """A box of full extents ``size``; ``front`` is the texture of its +y face if another."""
        faces = [texture] * 6
        if front is not None:
            faces[3] = front
        self._add(BOX, centre, np.asarray(size, float) / 2, faces, rotation, emission)

    def rectangle(self, centre: Triple, size: Pair, texture: int, rotation: np.ndarray) -> None:
        """A rectangle whose local x, y span it and whose local z faces the viewer."""
        half = np.array([size[0] / 2, size[1] / 2, 0.0])
        self._add(BOX, centre, half, [texture] * 6, rotation, 0.0)

    def frustum(
        self,
        base: Triple,
        radii: Pair,
        height: Number,
        texture: int,
        *,
        emission: Number = 0.0,
    ) -> None:
        """An upright cone frustum on ``base``, the centre of its lower disc; radii below, above."""
        half = np.array([radii[0], radii[1], height / 2])
        centre = (base[0], base[1], base[2] + height / 2)
        self._add(FRUSTUM, centre, half, [texture] * 6, None, emission)

    def ellipsoid(
        self,
        centre: Triple,
        radii: Triple,
        texture: int,
        *,
        rotation: np.ndarray | None = None,
        emission: Number = 0.0,
    ) -> None:
        """An ellipsoid with the given radii along its local axes."""
        self._add(ELLIPSOID, centre, np.asarray(radii, float), [texture] * 6, rotation, emission)

    def build(self, size: Triple, sky: Texture | None = None) -> Scene:
        """The scene so far, which fills [0, size], under a sky or a ceiling."""
        p = self._parts
        return Scene(
            size=np.asarray(size, float),
            kind=np.array(p.kind, np.int64),
            rotation=np.array(p.rotation, float),
            centre=np.array(p.centre, float),
            half=np.array(p.half, float),
            face_texture=np.array(p.face_texture, np.int64),
            texture_shift=np.array(p.texture_shift, float),
            emission=np.array(p.emission, float),
            textures=tuple(p.textures),
            lights=tuple(p.lights),
            sky=sky,
        )

    def _add(
        self,
        kind: int,
        centre: Triple,
        half: np.ndarray,
        faces: list[int],
        rotation: np.ndarray | None,
        emission: Number,
    ) -> None:
        p = self._parts
        p.kind.append(kind)
        p.rotation.append(self._rotation @ (np.eye(3) if rotation is None else rotation))
        p.centre.append(self._origin + self._rotation @ np.asarray(centre, float))
        p.half.append(half)
        p.face_texture.append(faces)
        p.texture_shift.append(self._rng.uniform(0.0, 4.0, 2))
        p.emission.append(emission)
