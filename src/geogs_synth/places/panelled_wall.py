"""A wall of posters and shelves with a white panel in its middle, and a walk past it.

In front of the panel only the joints between its boards and what is beside it are left to match:
the two textured sides are joined by a weak link.
"""

import numpy as np
from jaxtyping import Float64

from geogs_synth.motion.handheld import look_at, with_shake
from geogs_synth.motion.room_motions import Motion
from geogs_synth.scene.builder import FACING_Y, SceneBuilder
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.textures import artwork, patterns

WALK_METRES = 4.0
"""Length of the walk from the first frame to the last."""
_SIZE = 8.0, 4.0, 2.8
_EYE_HEIGHT, _DISTANCE = 1.35, 1.6
_SPEED, _RATE = 0.9, 15.0
"""Metres a second and frames a second: 6 cm from one frame to the next."""
_TEXEL = 0.004


def make_panelled_wall(panel: float, board: float, seed: int = 0) -> Scene:
    """A wall with a white panel of ``panel`` metres, of boards that are ``board`` metres wide; the
    same seed always gives the same wall."""
    rng = np.random.default_rng([seed, 0x9A11])
    length, depth, height = _SIZE
    build = SceneBuilder(rng)
    wall = build.at(length / 2, 0)
    shape = (round(height / _TEXEL), round(length / _TEXEL))
    colour = patterns.random_colour(rng, (0.1, 0.4), (0.5, 0.8))
    ground = wall.texture(patterns.plaster(rng, shape, colour))
    wall.rectangle((0, 0, height / 2), (length, height), ground, FACING_Y)
    white = patterns.panels(
        rng, (700, round(panel / _TEXEL)), (350.0, board / _TEXEL), (214, 214, 210), 0.1
    )
    wall.box((0, 0.01, height / 2), (panel, 0.02, height), wall.texture(white))
    for side in (-1, 1):
        _pictures(wall, rng, side, panel / 2)
    for x in np.arange(1.0, length, 2.0):
        build.light((x, depth / 2, height - 0.1), (1.0, 0.98, 0.94), 0.6)
    return build.build(_SIZE)


def _pictures(wall: SceneBuilder, rng: np.random.Generator, side: int, start: float) -> None:
    """Two rows of posters on boxes of various depths, from the panel outwards."""
    for bottom in (0.35, 1.4):
        x = start + rng.uniform(0.05, 0.15)
        while x < _SIZE[0] / 2 - 0.6:
            width, tall, thick = rng.uniform((0.35, 0.6, 0.04), (0.6, 0.95, 0.35))
            image = artwork.poster(rng, (round(tall / _TEXEL), round(width / _TEXEL)))
            middle = (side * (x + width / 2), thick / 2, bottom + tall / 2)
            wall.box(middle, (width, thick, tall), wall.texture(image))
            x += width + rng.uniform(0.03, 0.15)


def walk_past(seed: int = 0) -> Motion:
    """A walk past the panel that faces the wall, in a hand that sways a little."""
    rng = np.random.default_rng([seed, 0x9A12])
    phases = rng.uniform(0, 2 * np.pi, 3)
    start = (_SIZE[0] - WALK_METRES) / 2

    def path(times: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 4 4"]:
        x = start + _SPEED * times
        y = _DISTANCE + 0.1 * np.sin(2 * np.pi * times / 4.1 + phases[0])
        z = _EYE_HEIGHT + 0.05 * np.sin(2 * np.pi * times / 2.9 + phases[1])
        yaw = np.radians(4.0) * np.sin(2 * np.pi * times / 3.3 + phases[2])
        position = np.column_stack([x, y, z])
        ahead = np.column_stack([np.sin(yaw), -np.cos(yaw), np.full_like(x, -0.03)])
        return with_shake(look_at(position, position + ahead), seed, _RATE * times)

    return Motion(path, _RATE, WALK_METRES / _SPEED)
