"""A room or a street of a sequence: textured solids, lights, a sky.

Faces are numbered 0..5 for -x, +x, -y, +y, -z, +z of a solid's local frame; the round side of a
frustum and the whole ellipsoid are face 0.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from geogs_synth.scene.solids import Solids


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
