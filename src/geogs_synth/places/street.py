"""A street between houses from a seed, and a drive along it."""

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from geogs_synth.motion.handheld import look_at
from geogs_synth.motion.room_motions import Motion
from geogs_synth.places.vehicles import VehicleMaterials, car, draw_materials
from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.scene.textured_scene import Scene, Texture
from geogs_synth.textures import artwork, patterns
from geogs_synth.textures.patterns import Colour, finish, fractal_noise

LENGTH = 260.0
DRIVE_METRES = 205.0
"""Length of the drive from its first frame to its end."""
LANE = -1.4
"""Lateral position of the camera, metres to the left of the middle of the road."""
DRIVE_RATE = 10.0

_WIDTH, _HEIGHT = 46.0, 18.0
_BEND, _BEND_LENGTH = 5.0, 170.0
_ROAD_HALF, _PAVEMENT = 4.5, 2.6
_SECTION = 8.0
START = 14.0
"""Distance along the street of the first frame, in metres."""
_SPEED, _SPEED_WAVE, _SPEED_PERIOD = 10.0, 4.0, 12.0
_EYE_HEIGHT = 1.65
_SUN = (-60.0, -120.0, 240.0)
_DRIVE_STREAM = 0xD71
FACADE_TEXEL, ROAD_TEXEL = 0.022, 0.0125
"""Metres per texel."""


def heading(x: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    """Direction of the road in radians from x."""
    return np.arctan(2 * np.pi * _BEND / _BEND_LENGTH * np.cos(2 * np.pi * x / _BEND_LENGTH))


def on_road(x: Float64[np.ndarray, "n"], left: Float64[np.ndarray, "n"]) -> np.ndarray:
    """n x 2 points ``left`` metres beside the middle of the road, a gentle wave, at x along it."""
    yaw = heading(x)
    middle = np.column_stack([x, _WIDTH / 2 + _BEND * np.sin(2 * np.pi * x / _BEND_LENGTH)])
    return middle + left[:, None] * np.stack([-np.sin(yaw), np.cos(yaw)], 1)


def make_street(seed: int = 0, length: float = LENGTH) -> Scene:
    """A street of ``length`` metres that bends gently; the same seed always gives the same one.

    House fronts with windows on either side, a road with markings, pavements, parked cars, trees,
    poles with signs; above them the sky.
    """
    rng = np.random.default_rng([seed, 0x57E])
    build = SceneBuilder(rng)
    _ground(build, rng, length)
    materials = draw_materials(build, rng)
    for side in (-1, 1):
        _houses(build, rng, side, length)
        _parked_cars(build, rng, side, length, materials)
        _kerbside(build, rng, side, length)
    _end(build, rng, length)
    sun = np.array([length / 2, _WIDTH / 2, 0]) + _SUN
    strength = 1.2 * float(np.dot(_SUN, _SUN))
    build.light(sun, (1.05 * strength, strength, 0.92 * strength), 3.0)
    return build.build((length, _WIDTH, _HEIGHT), Texture(_sky(rng), 0.0))


def drive(seed: int = 0) -> Motion:
    """A drive in the right lane: 6 to 14 m/s, with some steering and pitching."""
    rng = np.random.default_rng([seed, _DRIVE_STREAM])
    phases = rng.uniform(0, 2 * np.pi, 5)

    def path(times: np.ndarray) -> np.ndarray:
        x = START + driven(times, seed)
        left = LANE + 0.2 * np.sin(2 * np.pi * x / 47 + phases[0])
        bounce = np.sin(2 * np.pi * 1.4 * times + phases[1])
        height = _EYE_HEIGHT + 0.012 * bounce
        ahead = x + 5.0
        aim = on_road(ahead, LANE + 0.2 * np.sin(2 * np.pi * ahead / 47 + phases[0]))
        nod = 5 * np.radians(0.4 * np.sin(2 * np.pi * 1.4 * times + phases[2]) - 0.5)
        nod += 5 * np.radians(0.3 * np.sin(2 * np.pi * 0.6 * times + phases[3]))
        position = np.column_stack([on_road(x, left), height])
        return look_at(position, np.column_stack([aim, height + nod]))

    return Motion(path, DRIVE_RATE, _seconds_of_drive(seed))


def driven(times: Float64[np.ndarray, "n"], seed: int) -> Float64[np.ndarray, "n"]:
    """Distance driven along the street at times in seconds, metres."""
    phase = float(np.random.default_rng([seed, _DRIVE_STREAM, 1]).uniform(0, 2 * np.pi))
    rate = 2 * np.pi / _SPEED_PERIOD
    wave = np.cos(phase) - np.cos(rate * times + phase)
    return _SPEED * times + _SPEED_WAVE / rate * wave


def _seconds_of_drive(seed: int) -> float:
    times = np.arange(0, DRIVE_METRES / (_SPEED - _SPEED_WAVE), 1 / DRIVE_RATE)
    return float(times[driven(times, seed) < DRIVE_METRES][-1])


def _section(
    build: SceneBuilder, x: float, left: float = 0.0, backwards: bool = False
) -> SceneBuilder:
    """A frame beside the middle of the road: x along it, or against it if ``backwards``."""
    at = np.array([x])
    (px, py), yaw = on_road(at, np.array([left]))[0], float(heading(at)[0])
    return build.at(float(px), float(py), yaw=yaw + (np.pi if backwards else 0.0))


def _ground(build: SceneBuilder, rng: np.random.Generator, length: float) -> None:
    """Bare ground all around, the road and the pavements in sections."""
    bare = build.texture(patterns.plaster(rng, (1024, 1024), (126, 122, 104)), 0.02)
    build.rectangle((length / 2, _WIDTH / 2, 0), (900, 700), bare, np.eye(3))
    surfaces = [build.texture(_road(rng, _SECTION + 0.6, 2 * _ROAD_HALF)) for _ in range(8)]
    slabs = build.texture(
        patterns.tiles(rng, (768, 768), 16, ((150, 146, 138), (136, 132, 126))), 0.008
    )
    for k, x in enumerate(np.arange(_SECTION / 2, length, _SECTION).tolist()):
        # Sections overlap at their joints, so neighbours lie at different heights.
        z = 0.03 + 0.004 * (k % 2)
        section = _section(build, x)
        surface = surfaces[rng.integers(len(surfaces))]
        section.rectangle((0, 0, z), (_SECTION + 0.6, 2 * _ROAD_HALF), surface, np.eye(3))
        for side in (-1, 1):
            size = (_SECTION + 0.6, _PAVEMENT, 0.15 + 0.004 * (k % 2))
            section.box((0, side * (_ROAD_HALF + _PAVEMENT / 2), size[2] / 2), size, slabs)


def _houses(build: SceneBuilder, rng: np.random.Generator, side: int, length: float) -> None:
    """A row of houses, some with a gap; their +y faces look to the road."""
    plain = build.texture(patterns.plaster(rng, (512, 512), (160, 150, 138)), 0.01)
    front_at = _ROAD_HALF + _PAVEMENT
    x = 0.0
    while x < length:
        width, height, depth = rng.uniform([8, 6.0, 6], [14, 14.0, 8])
        middle = x + width / 2
        house = _section(build, middle, side * (front_at + rng.uniform(0, 0.5)), backwards=side > 0)
        front = build.texture(_facade(rng, width, height))
        house.box((0, -depth / 2, height / 2), (width, depth, height), plain, front=front)
        house.box((0, -depth / 2, height + 0.15), (width + 0.3, depth + 0.6, 0.3), plain)
        for _ in range(int(rng.integers(0, 4))):
            across = rng.uniform(-0.4, 0.4) * width
            storey = rng.integers(1, max(2, height // 3))
            z = storey * 3.0
            house.box((across, 0.4, z), (1.6, 0.8, 0.12), plain)
            house.box((across, 0.78, z + 0.45), (1.6, 0.05, 0.8), plain)
        x += width + (rng.uniform(1.0, 4.0) if rng.random() < 0.3 else 0.0)


def _parked_cars(
    build: SceneBuilder,
    rng: np.random.Generator,
    side: int,
    length: float,
    materials: VehicleMaterials,
) -> None:
    x = rng.uniform(4, 10)
    while x < length - 8:
        place = _section(build, x, side * (_ROAD_HALF - 1.0), backwards=side > 0)
        car(place.at(0, 0, 0.03, yaw=rng.uniform(-0.03, 0.03)), rng, materials)
        x += rng.uniform(5.2, 7.5) if rng.random() < 0.7 else rng.uniform(12, 26)


def _kerbside(build: SceneBuilder, rng: np.random.Generator, side: int, length: float) -> None:
    """Trees and poles alternating along the pavement."""
    bark = build.texture(patterns.plaster(rng, (256, 256), (104, 84, 64)), 0.004)
    metal = build.texture(patterns.plaster(rng, (256, 256), (120, 124, 128)), 0.004)
    leaves = [
        build.texture(patterns.plaster(rng, (384, 768), colour), 0.012)
        for colour in ((86, 124, 62), (104, 132, 58), (70, 108, 60))
    ]
    x = rng.uniform(6, 12)
    while x < length - 6:
        spot = _section(build, x, side * (_ROAD_HALF + 0.6))
        if rng.random() < 0.5:
            _tree(spot, rng, bark, leaves[rng.integers(len(leaves))])
        else:
            _pole(spot, rng, metal, side)
        x += rng.uniform(7, 14)


def _tree(spot: SceneBuilder, rng: np.random.Generator, bark: int, leaves: int) -> None:
    tall = rng.uniform(2.2, 3.2)
    spot.frustum((0, 0, 0.1), (0.16, 0.1), tall, bark)
    for _ in range(6):
        radii = rng.uniform([0.5, 0.5, 0.4], [1.0, 1.0, 0.8])
        offset = rng.uniform([-0.8, -0.8, -0.2], [0.8, 0.8, 1.6])
        spot.ellipsoid(np.array([0, 0, tall + 0.5]) + offset, radii, leaves)


def _pole(spot: SceneBuilder, rng: np.random.Generator, metal: int, side: int) -> None:
    spot.frustum((0, 0, 0.1), (0.08, 0.06), 5.2, metal)
    spot.box((0, -side * 0.7, 5.3), (0.25, 1.5, 0.1), metal)
    if rng.random() < 0.6:
        sign = spot.texture(artwork.poster(rng, (240, 320)))
        spot.box((0, 0, 2.5), (0.06, 0.9, 0.7), sign)


def _end(build: SceneBuilder, rng: np.random.Generator, length: float) -> None:
    """A large house across the end of the street."""
    front = build.texture(_facade(rng, 30.0, 15.0))
    plain = build.texture(patterns.plaster(rng, (512, 512), (150, 140, 130)), 0.01)
    house = _section(build, length - 1.0)
    # Its +y face looks back along the street.
    house.at(0, 0, yaw=np.pi / 2).box((0, -3, 7.5), (30, 6, 15), plain, front=front)


def _facade(rng: np.random.Generator, width: float, height: float) -> UInt8[np.ndarray, "h w 3"]:
    """A front of brick or plaster with rows of windows and a door; sizes in metres."""
    shape = (round(height / FACADE_TEXEL), round(width / FACADE_TEXEL))
    red, green, blue = rng.uniform([120, 95, 75], [215, 195, 170])
    colour: Colour = (float(red), float(green), float(blue))
    if rng.random() < 0.5:
        image = patterns.brick(rng, shape, max(8, round(height / 0.14)), colour)
    else:
        image = patterns.plaster(rng, shape, colour)
    image = np.ascontiguousarray(image)
    storeys = max(2, round(height / 3.0))
    columns = max(2, round(width / 2.6))
    door = int(rng.integers(columns))
    glass = float(rng.uniform(40, 90))
    for storey in range(storeys):
        for column in range(columns):
            middle = (column + 0.5) * width / columns
            bottom = storey * height / storeys
            if storey == 0 and column == door:
                _opening(rng, image, height, (middle, 0.0), (1.2, 2.3), 90.0)
            else:
                size = (1.3, min(1.6, 0.6 * height / storeys))
                _opening(rng, image, height, (middle, bottom + 0.9), size, glass)
    return image


def _opening(
    rng: np.random.Generator,
    image: UInt8[np.ndarray, "h w 3"],
    height: float,
    foot: tuple[float, float],
    size: tuple[float, float],
    glass: float,
) -> None:
    """A window or door with frame and bars, its lower edge in the middle at ``foot`` metres."""
    low = np.array([foot[0] - size[0] / 2, height - foot[1] - size[1]]) / FACADE_TEXEL
    high = np.array([foot[0] + size[0] / 2, height - foot[1]]) / FACADE_TEXEL
    (left, top), (right, bottom) = low.astype(int).tolist(), high.astype(int).tolist()
    left, top, bottom = max(left, 0), max(top, 0), min(bottom, image.shape[0])
    shape = image[top:bottom, left:right].shape[:2]
    if min(shape) < 8:
        return
    reflection = fractal_noise(rng, shape, (3, 3), 5, 0.8)
    pane = np.array([0.9, 1.0, 1.15]) * glass * (1 + 0.35 * reflection[..., None])
    image[top:bottom, left:right] = finish(pane)
    frame = tuple(float(c) for c in rng.uniform(150, 240, 3))
    bar = max(2, round(0.06 / FACADE_TEXEL))
    cv2.rectangle(image, (left, top), (right - 1, bottom - 1), frame, 2 * bar)
    middle = (left + right) // 2
    cv2.line(image, (middle, top), (middle, bottom - 1), frame, bar)
    third = top + (bottom - top) // 3
    cv2.line(image, (left, third), (right - 1, third), frame, bar)


def _road(rng: np.random.Generator, length: float, width: float) -> UInt8[np.ndarray, "h w 3"]:
    """Asphalt with patches, cracks and markings; runs along x, sizes in metres."""
    shape = (round(width / ROAD_TEXEL), round(length / ROAD_TEXEL))
    ground = patterns.plaster(rng, shape, (104, 104, 108)).astype(np.float32)
    grit = fractal_noise(rng, shape, (shape[0] / 3, shape[1] / 3), 2)
    patches = np.clip(2 * fractal_noise(rng, shape, (3, 4), 4, 0.6) - 1.5, 0, 1)
    image = ground * (1 + 0.09 * grit - 0.3 * patches)[..., None]
    worn = 0.75 + 0.15 * fractal_noise(rng, shape, (12, 12), 5, 0.8)
    paint = np.zeros(shape, np.float32)
    line = round(0.14 / ROAD_TEXEL)
    middle = shape[0] // 2
    paint[middle - line // 2 : middle + line // 2 + 1, : round(0.45 * shape[1])] = 1
    for edge in (round(0.13 * shape[0]), round(0.87 * shape[0])):
        paint[edge - line // 2 : edge + line // 2 + 1] = 1
    alpha = (paint * np.clip(worn, 0, 1))[..., None]
    return finish(image * (1 - alpha) + 225 * alpha)


def _sky(rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Blue with clouds above the horizon, haze below; rows are latitudes from the zenith down."""
    h, w = 512, 2048
    latitude = np.linspace(90, -90, h)[:, None]
    rise = np.clip(latitude / 60, 0, 1)[..., None]
    image = (1 - rise) * np.array([214, 224, 236.0]) + rise * np.array([96, 142, 208.0])
    clouds = fractal_noise(rng, (h, w), (8, 12), 6, 0.6)[..., None]
    alpha = np.clip(1.2 * clouds - 0.3, 0, 0.85) * np.clip(latitude / 8, 0, 1)[..., None]
    image = np.broadcast_to(image, (h, w, 3)) * (1 - alpha) + 246 * alpha
    image = np.where(latitude[..., None] < -0.5, np.array([150, 152, 146.0]), image)
    return finish(image)
