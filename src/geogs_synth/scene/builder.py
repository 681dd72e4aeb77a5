"""Builds scenes of solids that are given in frames of their own."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, Solids
from geogs_synth.scene.textured_scene import Light, Scene, Texture

Number = float | int
Triple = Sequence[Number] | Float64[np.ndarray, "3"]
Pair = tuple[Number, Number]


FACING_Y = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
"""Rotation of a rectangle that stands upright and faces along y."""
FACING_DOWN = np.diag([1.0, -1, -1])
"""Rotation of a rectangle that faces down."""


def yaw_rotation(yaw: Number) -> Float64[np.ndarray, "3 3"]:
    """Rotation by ``yaw`` radians about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class SceneBuilder:
    """Collects solids given in a local frame; ``at`` opens a frame inside this one.

    The frames of furniture have x to the right along the wall behind it, y into the room, z up.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._solids: list[tuple[Any, ...]] = []
        self._textures: list[Texture] = []
        self._lights: list[Light] = []
        self._rng = rng
        self._rotation = np.eye(3)
        self._origin = np.zeros(3)

    def at(self, x: Number, y: Number, z: Number = 0.0, yaw: Number = 0.0) -> "SceneBuilder":
        """A builder for a frame inside this one; its solids are added to the same scene."""
        child = copy.copy(self)
        child._rotation = self._rotation @ yaw_rotation(yaw)
        child._origin = self._origin + self._rotation @ np.array([x, y, z])
        return child

    def texture(self, image: UInt8[np.ndarray, "h w 3"], metres_per_texel: float = 0.0) -> int:
        """Register a texture and return its index; without a scale it is stretched over faces."""
        self._textures.append(Texture(image, metres_per_texel))
        return len(self._textures) - 1

    def light(self, position: Triple, colour: tuple[float, float, float], radius: float) -> None:
        """Adds a light at a position of this frame."""
        x, y, z = self._origin + self._rotation @ np.asarray(position, float)
        self._lights.append(Light((float(x), float(y), float(z)), colour, radius))

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
        self, base: Triple, radii: Pair, height: Number, texture: int, *, emission: Number = 0.0
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
        kind, rotation, centre, half, faces, shift, emission = zip(*self._solids, strict=True)
        return Scene(
            size=np.asarray(size, float),
            solids=Solids(np.array(kind), np.array(rotation), np.array(centre), np.array(half)),
            face_texture=np.array(faces, np.int64),
            texture_shift=np.array(shift, float),
            emission=np.array(emission, float),
            textures=tuple(self._textures),
            lights=tuple(self._lights),
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
        local = np.eye(3) if rotation is None else rotation
        shift = self._rng.uniform(0.0, 4.0, 2)
        place = self._origin + self._rotation @ np.asarray(centre, float)
        turned = self._rotation @ local
        self._solids.append((kind, turned, place, half, faces, shift, emission))
