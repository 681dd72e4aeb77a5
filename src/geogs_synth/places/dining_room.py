"""A room of thin things from a seed: legs of table and chairs, a railing, a lattice, a cable."""

import math

import numpy as np

from geogs_synth.places import furniture
from geogs_synth.places.furniture import Materials
from geogs_synth.places.room import Wall, add_picture, add_window, cover_surfaces, room_walls
from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.scene.textured_scene import Scene

_TABLE_HEIGHT = 0.74
_CHAIR_IN = 0.24
"""Metres by which a chair is pushed under the table."""


def make_dining_room(seed: int = 0) -> Scene:
    """A room of about 6.5 x 6 x 2.7 m; the same seed always gives the same room.

    In the middle stands a table with six chairs, below a lamp on a cable; before the walls, in an
    order drawn at random, a railing, a lattice with plants, a narrow table on legs beneath a
    window, and a sideboard with two standing lamps.
    """
    rng = np.random.default_rng([seed, 0xD17])
    size = rng.uniform([6.3, 5.8, 2.6], [6.8, 6.2, 2.8])
    build = SceneBuilder(rng)
    materials = furniture.make_materials(build, rng)
    walls = room_walls(build, size)
    cover_surfaces(build, rng, size, walls, materials)
    for wall, piece in zip(walls, rng.permutation(4), strict=True):
        _furnish(wall, int(piece), rng, materials, size[2])
    middle = build.at(size[0] / 2, size[1] / 2, yaw=rng.uniform(-0.3, 0.3))
    _table_and_chairs(middle, rng, materials)
    _hanging_lamp(middle, materials, size[2])
    return build.build(size)


def _furnish(
    wall: Wall, piece: int, rng: np.random.Generator, materials: Materials, height: float
) -> None:
    """Furnish a wall: a piece before it, and pictures behind the piece."""
    match piece:
        case 0:
            railing(wall.build.at(0, rng.uniform(0.4, 0.6)), rng, materials, 0.8 * wall.width)
            for x in (-1.1, 0.2, 1.3):
                add_picture(wall.build, rng, materials, x, rng.uniform(1.45, 1.6), 0.55)
        case 1:
            lattice(wall.build.at(0, rng.uniform(0.25, 0.4)), rng, materials, 1.9)
            for side in (-1, 1):
                furniture.plant(wall.build.at(side * 1.4, 0.36), rng, materials)
                add_picture(wall.build, rng, materials, 0.5 * side, 1.5, 0.5)
        case 2:
            _console(wall.build.at(0, 0.04), rng, materials)
            add_window(wall, rng, materials, height)
        case _:
            furniture.sideboard(wall.build.at(0, 0.02), rng, materials, rng.uniform(1.5, 1.9))
            for side in (-1, 1):
                furniture.floor_lamp(wall.build.at(side * 1.5, 0.4), materials)
                add_picture(wall.build, rng, materials, 0.7 * side, rng.uniform(1.5, 1.7), 0.6)


def railing(
    build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float
) -> None:
    """A row of balusters between two rails, and posts at its ends."""
    height = rng.uniform(0.85, 1.0)
    thick = rng.uniform(0.018, 0.03)
    for z in (0.1, height):
        build.box((0, 0, z), (width, 0.05, 0.04), materials.oak)
    for side in (-1, 1):
        build.box((side * width / 2, 0, height / 2), (0.07, 0.07, height + 0.08), materials.walnut)
    count = round(width / rng.uniform(0.1, 0.14))
    for x in np.linspace(-width / 2, width / 2, count + 1)[1:-1]:
        build.box((x, 0, (height + 0.1) / 2), (thick, thick, height - 0.14), materials.oak)


def lattice(
    build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float
) -> None:
    """A frame with upright and level bars that cross."""
    height = 1.8
    bar = rng.uniform(0.012, 0.02)
    cell = rng.uniform(0.16, 0.24)
    for x in np.linspace(-width / 2, width / 2, round(width / cell) + 1):
        build.box((x, 0, height / 2 + 0.05), (bar, bar, height), materials.lacquer)
    for z in np.linspace(0.1, height, round(height / cell) + 1):
        build.box((0, bar, z), (width, bar, bar), materials.lacquer)


def _console(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A narrow high table on four thin legs, with objects on it."""
    width = rng.uniform(1.2, 1.6)
    depth = 0.36
    height = 0.8
    build.box((0, depth / 2, height - 0.015), (width, depth, 0.03), materials.walnut)
    furniture.four_legs(build, width, depth, height - 0.03, 0.03, materials.metal)
    build.box((0, depth / 2, 0.2), (width - 0.06, depth - 0.06, 0.02), materials.walnut)
    for x in (-0.4, 0.0, 0.4):
        furniture.trinket(build.at(x, depth / 2, height), rng, materials)


def _table_and_chairs(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A table and six chairs, pushed under it or turned a little, no two alike."""
    width = rng.uniform(1.5, 1.8)
    depth = rng.uniform(0.85, 0.95)
    top = (width, depth, 0.03)
    build.box((0, 0, _TABLE_HEIGHT - 0.015), top, materials.walnut)
    legs = build.at(0, -depth / 2)
    furniture.four_legs(legs, width, depth, _TABLE_HEIGHT - 0.03, 0.05, materials.walnut)
    side = depth / 2 - _CHAIR_IN
    end = width / 2 - _CHAIR_IN
    places = [(s * width / 4, t * side, (1 - t) * math.pi / 2) for s in (-1, 1) for t in (-1, 1)]
    places += [(end, 0.0, -math.pi / 2), (-end, 0.0, math.pi / 2)]
    for x, y, yaw in places:
        out = rng.uniform(0, 0.1)
        dx, dy = -math.sin(yaw) * out, math.cos(yaw) * out
        furniture.chair(build.at(x + dx, y + dy, yaw=yaw + rng.uniform(-0.3, 0.3)), rng, materials)
    for x in (-0.5, 0.0, 0.5):
        furniture.trinket(build.at(x, rng.uniform(-0.15, 0.15), _TABLE_HEIGHT), rng, materials)


def _hanging_lamp(build: SceneBuilder, materials: Materials, height: float) -> None:
    """A shade on a cable above the table, which lights the room."""
    low = height - 0.75
    build.frustum((0, 0, low + 0.18), (0.006, 0.006), height - low - 0.18, materials.metal)
    build.frustum((0, 0, low), (0.22, 0.05), 0.2, materials.shade, emission=1.0)
    build.light((0, 0, low - 0.05), (2.5, 2.35, 2.1), 0.2)
