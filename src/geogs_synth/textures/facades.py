"""Textures of a street: house fronts, the road with its markings, the sky."""

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs_synth.textures import patterns
from geogs_synth.textures.patterns import Colour, finish, fractal_noise

FACADE_TEXEL, ROAD_TEXEL = 0.022, 0.0125
"""Metres per texel."""


def facade(rng: np.random.Generator, width: float, height: float) -> UInt8[np.ndarray, "h w 3"]:
    """A front of brick or plaster with rows of windows and a door; sizes in metres."""
    shape = (round(height / FACADE_TEXEL), round(width / FACADE_TEXEL))
    red, green, blue = rng.uniform([120, 95, 75], [215, 195, 170])
    colour: Colour = (float(red), float(green), float(blue))
    if rng.random() < 0.5:
        image = patterns.brick(rng, shape, max(8, round(height / 0.14)), colour)
    else:
        image = patterns.plaster(rng, shape, colour)
    image = np.ascontiguousarray(image)
    storeys, columns = max(2, round(height / 3.0)), max(2, round(width / 2.6))
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


def road(rng: np.random.Generator, length: float, width: float) -> UInt8[np.ndarray, "h w 3"]:
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


def sky(rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
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
