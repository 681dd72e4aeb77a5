"""A furnished room from a seed."""

import math
from dataclasses import dataclass

import numpy as np

from geogs_synth.places import furniture
from geogs_synth.places.furniture import Materials
from geogs_synth.scene.builder import FACING_DOWN, FACING_Y, SceneBuilder
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.textures import artwork, patterns

_TEXEL = 0.003
"""Metres per texel of walls, floor and ceiling."""


@dataclass(frozen=True)
class Wall:
    """A wall with its frame: x to the right along it seen from behind, y into the room."""

    build: SceneBuilder
    width: float


def make_room(seed: int = 0) -> Scene:
    """A room of about 4.5 x 4 x 2.6 m; the same seed always gives the same room.

    Walls, floor and ceiling differ in material; along the walls stand a shelf, a sofa, a desk and
    a sideboard in an order drawn at random, with pictures and a window; the middle is free above a
    low round table, so that a camera can move there.
    """
    rng = np.random.default_rng([seed, 0x600])
    size = rng.uniform([4.3, 3.9, 2.55], [5.0, 4.3, 2.75])
    build = SceneBuilder(rng)
    materials = furniture.make_materials(build, rng)
    walls = room_walls(build, size)
    cover_surfaces(build, rng, size, walls, materials)
    _furnish_walls(rng, walls, size[2], materials)
    _furnish_middle(build, rng, size, materials)
    return build.build(size)


def room_walls(build: SceneBuilder, size: np.ndarray) -> list[Wall]:
    """South, east, north, west, their frames at the middle of each wall on the floor."""
    w, d, _ = size
    return [
        Wall(build.at(w / 2, 0.0), w),
        Wall(build.at(w, d / 2, yaw=math.pi / 2), d),
        Wall(build.at(w / 2, d, yaw=math.pi), w),
        Wall(build.at(0.0, d / 2, yaw=-math.pi / 2), d),
    ]


def cover_surfaces(
    build: SceneBuilder,
    rng: np.random.Generator,
    size: np.ndarray,
    walls: list[Wall],
    materials: Materials,
) -> None:
    """Walls, floor, ceiling, beams and skirting."""
    h = size[2]
    kinds = rng.permutation(4)
    for wall, kind in zip(walls, kinds, strict=True):
        image = wall_image(rng, int(kind), wall.width, h)
        paper = build.texture(image)
        wall.build.rectangle((0, 0, h / 2), (wall.width, h), paper, FACING_Y)
        skirting = (wall.width - 0.04, 0.02, 0.1)
        wall.build.box((0, 0.01, 0.05), skirting, materials.lacquer)
    add_ceiling_and_floor(build, rng, size, materials)


def add_ceiling_and_floor(
    build: SceneBuilder, rng: np.random.Generator, size: np.ndarray, materials: Materials
) -> None:
    """Floor, ceiling and beams of a room that fills [0, size]."""
    w, d, h = size
    shape = (round(d / _TEXEL), round(w / _TEXEL))
    if rng.random() < 0.6:
        floor = patterns.planks(rng, shape, 26, (168, 124, 82))
    else:
        floor = patterns.tiles(rng, shape, 11, ((186, 172, 150), (128, 104, 86)))
    build.rectangle((w / 2, d / 2, 0), (w, d), build.texture(floor), np.eye(3))
    ceiling = build.texture(patterns.plaster(rng, shape, (206, 200, 188)))
    build.rectangle((w / 2, d / 2, h), (w, d), ceiling, FACING_DOWN)
    for x in np.linspace(0, w, 5)[1:-1]:
        build.box((x, d / 2, h - 0.06), (0.12, d, 0.12), materials.walnut)


def wall_image(rng: np.random.Generator, kind: int, width: float, height: float) -> np.ndarray:
    """Brick, two plasters or paper, as large as the wall."""
    shape = (round(height / _TEXEL), round(width / _TEXEL))
    match kind:
        case 0:
            return patterns.brick(rng, shape, 30, (168, 98, 76))
        case 1:
            r, g, b = rng.uniform([150, 160, 150], [215, 205, 210])
            return patterns.wallpaper(rng, shape, (float(r), float(g), float(b)), 22)
        case 2:
            return patterns.plaster(rng, shape, (198, 182, 150))
        case _:
            r, g, b = rng.uniform([120, 140, 140], [180, 190, 195])
            return patterns.plaster(rng, shape, (float(r), float(g), float(b)))


def _furnish_walls(
    rng: np.random.Generator, walls: list[Wall], height: float, materials: Materials
) -> None:
    """One main piece to each wall, smaller things beside it, pictures above."""
    for place, main in enumerate(rng.permutation(4)):
        wall = walls[place]
        aside = rng.choice((-1.0, 1.0)) * rng.uniform(0.1, 0.25)
        piece = wall.build.at(aside, 0.02)
        corner = wall.build.at(math.copysign(wall.width / 2 - 0.4, -aside), 0.36)
        match main:
            case 0:
                furniture.bookshelf(piece, rng, materials, rng.uniform(1.3, 1.8))
                furniture.plant(corner, rng, materials)
                beside = math.copysign(wall.width / 2 - 0.6, -aside)
                add_picture(wall.build, rng, materials, beside, 1.6, 0.5)
            case 1:
                furniture.sofa(piece, rng, materials, rng.uniform(1.8, 2.1))
                furniture.floor_lamp(corner, materials)
                for x in (-0.75, 0.0, 0.75):
                    add_picture(wall.build, rng, materials, x, rng.uniform(1.45, 1.6), 0.52)
            case 2:
                furniture.desk(piece, rng, materials, rng.uniform(1.2, 1.5))
                furniture.pouf(corner, rng, materials)
                add_window(wall, rng, materials, height)
            case _:
                furniture.sideboard(piece, rng, materials, rng.uniform(1.5, 1.9))
                for x in (-0.8, 0.1, 0.85):
                    add_picture(wall.build, rng, materials, x, rng.uniform(1.5, 1.7), 0.6)


def add_picture(
    wall: SceneBuilder,
    rng: np.random.Generator,
    materials: Materials,
    x: float,
    z: float,
    extent: float,
) -> None:
    """A poster, landscape or abstract in a frame."""
    draw = (artwork.poster, artwork.landscape, artwork.abstract)[rng.integers(3)]
    tall = draw is artwork.poster or rng.random() < 0.3
    shape = (420, 320) if tall else (300, 420)
    scale = extent * rng.uniform(0.9, 1.15) / 400
    canvas = wall.texture(draw(rng, shape))
    frame = (materials.oak, materials.walnut, materials.metal)[rng.integers(3)]
    furniture.picture(wall, (x, z), (shape[1] * scale, shape[0] * scale), canvas, frame)


def add_window(wall: Wall, rng: np.random.Generator, materials: Materials, height: float) -> None:
    """A window that glows and lights the room with daylight."""
    w, h = 1.5, 0.95
    z = height - 0.35 - h / 2
    view = wall.build.texture(artwork.outdoors(rng, (320, 500)))
    build = wall.build
    build.box((0, 0.01, z), (w, 0.02, h), view, emission=0.97)
    for side in (-1, 1):
        build.box((side * (w / 2 + 0.04), 0.025, z), (0.08, 0.05, h + 0.16), materials.lacquer)
        build.box((0, 0.025, z + side * (h / 2 + 0.04)), (w, 0.05, 0.08), materials.lacquer)
    build.box((0, 0.07, z - h / 2 - 0.09), (w + 0.24, 0.14, 0.025), materials.lacquer)
    build.light((0, 0.35, z), (1.8, 1.95, 2.2), 0.3)


def _furnish_middle(
    build: SceneBuilder, rng: np.random.Generator, size: np.ndarray, materials: Materials
) -> None:
    """Rug, round table, balls on the floor, the ceiling lamp."""
    w, d = size[:2]
    middle = build.at(w / 2, d / 2, yaw=rng.uniform(-0.3, 0.3))
    rug = build.texture(patterns.rug(rng, (512, 720)))
    middle.box((0, 0, 0.006), (2.3, 1.65, 0.012), rug)
    table = rng.uniform(-0.2, 0.2, 2)
    furniture.round_table(middle.at(table[0], table[1], 0.012), rng, materials)
    for _ in range(3):
        r = rng.uniform(0.06, 0.14)
        angle = rng.uniform(0, 2 * math.pi)
        x, y = table + rng.uniform(0.62, 0.8) * np.array([math.cos(angle), math.sin(angle)])
        ball = materials.ceramic[rng.integers(len(materials.ceramic))]
        middle.ellipsoid((x, y, 0.012 + r), (r, r, r), ball)
    add_ceiling_lamp(build, size, materials)


def add_ceiling_lamp(build: SceneBuilder, size: np.ndarray, materials: Materials) -> None:
    """A lamp in the middle of the ceiling, and its light."""
    w, d, h = size
    build.frustum((w / 2, d / 2, h - 0.2), (0.16, 0.22), 0.08, materials.shade, emission=1.0)
    build.light((w / 2, d / 2, h - 0.25), (2.5, 2.35, 2.1), 0.2)
