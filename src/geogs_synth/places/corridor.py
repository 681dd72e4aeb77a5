"""A corridor of white panels and tiles from a seed, and a walk along it.

Hardly anything in it has texture in two directions: visible are the joints between panels, between
tiles, and around doors.
"""

import numpy as np
from jaxtyping import Float64

from geogs_synth.motion.handheld import look_at, with_shake
from geogs_synth.motion.room_motions import Motion
from geogs_synth.scene.builder import FACING_DOWN, FACING_Y, SceneBuilder
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.textures import patterns

LENGTH = 26.0
WALK_METRES = 20.0
"""Length of the walk from the first frame to the last."""
_HEIGHT = 2.6
_START, _EYE_HEIGHT = 1.5, 1.5
_SPEED, _RATE = 1.17, 15.0
"""Metres a second and frames a second: 7.8 cm from one frame to the next."""
_LOOK_DEGREES, _LOOK_PERIOD = 9.0, 3.6
"""Rotation of the camera to either side in degrees, and its period in seconds."""
_TEXEL = 0.004


def make_corridor(seed: int = 0, length: float = LENGTH) -> Scene:
    """A corridor of ``length`` metres; the same seed always gives the same corridor.

    Painted panels on the walls and under the ceiling, one tone each, with narrow joints; tiles on
    the floor; doors of one colour, lamps, at either end a door, and here and there a sign.
    """
    rng = np.random.default_rng([seed, 0xC0D])
    width = rng.uniform(2.0, 2.6)
    build = SceneBuilder(rng)
    grey = rng.uniform(198, 222)
    white = (grey, grey, grey - 4)
    panel = rng.uniform(0.9, 1.25)
    tile = rng.uniform(0.3, 0.6)
    contrast = rng.uniform(0.06, 0.15)

    def surface(size: tuple[float, float], cell: tuple[float, float], tone: float) -> int:
        shape = (round(size[1] / _TEXEL), round(size[0] / _TEXEL))
        cells = (cell[1] / _TEXEL, cell[0] / _TEXEL)
        colour = (tone * white[0], tone * white[1], tone * white[2])
        return build.texture(patterns.panels(rng, shape, cells, colour, contrast))

    middle = (length / 2, width / 2)
    flat = (length, width)
    floor = surface(flat, (tile, tile), rng.uniform(0.55, 0.8))
    build.rectangle((*middle, 0), flat, floor, np.eye(3))
    ceiling = surface(flat, (0.6, 0.6), 0.95)
    build.rectangle((*middle, _HEIGHT), flat, ceiling, FACING_DOWN)
    for y, yaw in ((0.0, 0.0), (width, np.pi)):
        wall = build.at(length / 2, y, yaw=yaw)
        painted = surface((length, _HEIGHT), (panel, _HEIGHT / 2), 1.0)
        wall.rectangle((0, 0, _HEIGHT / 2), (length, _HEIGHT), painted, FACING_Y)
        _furnish(wall, rng, length)
    for x, yaw in ((0.0, -np.pi / 2), (length, np.pi / 2)):
        end = build.at(x, width / 2, yaw=yaw)
        painted = surface((width, _HEIGHT), (panel, _HEIGHT / 2), 0.9)
        end.rectangle((0, 0, _HEIGHT / 2), (width, _HEIGHT), painted, FACING_Y)
        _door(end, rng, 0.0)
    glow = build.texture(np.full((8, 8, 3), 248, np.uint8))
    for x in np.arange(1.2, length, 2.4):
        build.box((x, width / 2, _HEIGHT - 0.01), (1.2, 0.3, 0.02), glow, emission=1.0)
        build.light((x, width / 2, _HEIGHT - 0.1), (1.0, 0.98, 0.94), 0.4)
    return build.build((length, width, _HEIGHT))


def walk(scene: Scene, seed: int = 0) -> Motion:
    """A walk along the corridor; the camera rotates a little to one side and to the other."""
    rng = np.random.default_rng([seed, 0xC0E])
    phases = rng.uniform(0, 2 * np.pi, 3)
    middle = scene.size[1] / 2

    def path(times: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 4 4"]:
        x = _START + _SPEED * times
        y = middle + 0.2 * np.sin(2 * np.pi * times / 5.3 + phases[0])
        z = _EYE_HEIGHT + 0.02 * np.sin(2 * np.pi * 1.9 * times + phases[1])
        yaw = np.radians(_LOOK_DEGREES) * np.sin(2 * np.pi * times / _LOOK_PERIOD + phases[2])
        position = np.column_stack([x, y, z])
        ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.full_like(x, -0.12)])
        T_wc = look_at(position, position + ahead)
        return with_shake(T_wc, seed, _RATE * times)

    return Motion(path, _RATE, WALK_METRES / _SPEED)


def _furnish(wall: SceneBuilder, rng: np.random.Generator, length: float) -> None:
    """Doors along a wall, and a skirting between them."""
    dark = wall.texture(np.full((8, 8, 3), rng.uniform(90, 130), np.uint8))
    wall.box((0, 0.008, 0.05), (length, 0.016, 0.1), dark)
    x = -length / 2 + rng.uniform(1.5, 4.0)
    while x < length / 2 - 1.0:
        _door(wall, rng, x)
        x += rng.uniform(4.0, 9.0)


def _door(wall: SceneBuilder, rng: np.random.Generator, x: float) -> None:
    """A door of one colour in a frame, with a handle and now and then a sign beside it."""
    colour = patterns.random_colour(rng, (0.0, 0.15), (0.6, 0.8))
    leaf = wall.texture(np.full((8, 8, 3), colour, np.uint8))
    frame = wall.texture(np.full((8, 8, 3), rng.uniform(150, 190), np.uint8))
    wall.box((x, 0.01, 1.0), (0.9, 0.02, 2.0), leaf)
    for side in (-1, 1):
        wall.box((x + side * 0.48, 0.02, 1.03), (0.06, 0.04, 2.06), frame)
    wall.box((x, 0.02, 2.03), (0.9, 0.04, 0.06), frame)
    wall.box((x + 0.36, 0.04, 1.05), (0.12, 0.05, 0.02), frame)
    if rng.random() < 0.5:
        wall.box((x + 0.75, 0.005, 1.6), (0.18, 0.01, 0.12), frame)
