"""Cars and vans as groups of solids.

Each stands on the origin of its frame: x forward, y to the left, z up; sizes in metres.
"""

from dataclasses import dataclass

import numpy as np

from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.textures import artwork, patterns

VAN_LENGTH, VAN_WIDTH, VAN_HEIGHT = 5.2, 2.0, 2.4
_TEXEL = 0.006


@dataclass(frozen=True)
class VehicleMaterials:
    """Texture indices that vehicles share."""

    paints: tuple[int, ...]
    glass: int
    rubber: int
    plates: tuple[int, ...]


def draw_materials(
    build: SceneBuilder, rng: np.random.Generator, colours: int = 12
) -> VehicleMaterials:
    """Draw the shared textures."""

    def paint() -> int:
        colour = patterns.random_colour(rng, (0.05, 0.6), (0.3, 0.95))
        return build.texture(patterns.plaster(rng, (192, 384), colour), _TEXEL)

    glass = patterns.fabric(rng, (128, 256), (60, 70, 80), (140, 150, 160))
    rubber = patterns.plaster(rng, (96, 192), (52, 52, 56))
    return VehicleMaterials(
        tuple(paint() for _ in range(colours)),
        build.texture(glass, _TEXEL),
        build.texture(rubber, _TEXEL),
        tuple(build.texture(artwork.poster(rng, (60, 220))) for _ in range(colours)),
    )


def car(build: SceneBuilder, rng: np.random.Generator, materials: VehicleMaterials) -> None:
    """A car of about 4.2 x 1.75 x 1.45 m."""
    length, width = rng.uniform([3.8, 1.68], [4.5, 1.8])
    paint = materials.paints[rng.integers(len(materials.paints))]
    plate = materials.plates[rng.integers(len(materials.plates))]
    build.box((0, 0, 0.62), (length, width, 0.62), paint)
    build.ellipsoid((0.46 * length, 0, 0.6), (0.22, 0.46 * width, 0.26), paint)
    build.ellipsoid((-0.46 * length, 0, 0.66), (0.2, 0.46 * width, 0.28), paint)
    build.box((-0.06 * length, 0, 1.12), (0.5 * length, 0.9 * width, 0.4), materials.glass)
    build.box((-0.06 * length, 0, 1.36), (0.46 * length, 0.88 * width, 0.1), paint)
    _wheels(build, length, width, materials.rubber)
    for side in (-1, 1):
        build.box((side * (length / 2 + 0.14), 0, 0.52), (0.16, 0.52, 0.14), plate)


def van(build: SceneBuilder, rng: np.random.Generator, materials: VehicleMaterials) -> None:
    """A box van with pictures on its sides and its doors."""
    picture = build.texture(artwork.abstract(rng, (320, 400)))
    load = VAN_LENGTH - 1.4
    middle = -VAN_LENGTH / 2 + load / 2
    cab = VAN_LENGTH / 2
    build.box((middle, 0, 1.45), (load, VAN_WIDTH, VAN_HEIGHT - 0.5), picture)
    build.box((middle, 0, 0.45), (load, VAN_WIDTH - 0.1, 0.2), materials.rubber)
    build.box((cab - 0.7, 0, 0.85), (1.4, VAN_WIDTH - 0.1, 0.9), materials.paints[0])
    build.box((cab - 0.9, 0, 1.6), (1.0, VAN_WIDTH - 0.2, 0.7), materials.glass)
    _wheels(build, VAN_LENGTH, VAN_WIDTH, materials.rubber)


def _wheels(build: SceneBuilder, length: float, width: float, dark: int) -> None:
    for along in (-0.31, 0.31):
        for side in (-1, 1):
            centre = (along * length, side * (width / 2 - 0.06), 0.32)
            build.ellipsoid(centre, (0.32, 0.12, 0.32), dark)
