"""Procedural pictures: posters, landscapes, abstract paintings, book spines and a view outside."""

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs_synth.textures.patterns import finish, fractal_noise, random_colour

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
_LETTERS = "ABCDEFGHIKLMNOPRSTUVW"


def _random_word(rng: np.random.Generator, length: int) -> str:
    return "".join(_LETTERS[i] for i in rng.integers(0, len(_LETTERS), length))


def _write_line(
    rng: np.random.Generator, image: np.ndarray, left: int, base: int, width: int, height: int
) -> None:
    """One line of nonsense capitals scaled to ``height`` texels, cut off at ``width``."""
    font = _FONTS[rng.integers(len(_FONTS))]
    text = " ".join(_random_word(rng, int(n)) for n in rng.integers(2, 9, 6))
    scale = height / 30
    while len(text) > 1 and cv2.getTextSize(text, font, scale, 1)[0][0] > width:
        text = text[:-1]
    ink = tuple(int(c) for c in rng.uniform(10, 80, 3))
    thickness = max(1, round(height / 14))
    cv2.putText(image, text, (left, base), font, scale, ink, thickness, cv2.LINE_AA)


def _print_grain(rng: np.random.Generator, image: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    """The tooth of paper or canvas over a drawn image."""
    h, w = image.shape[:2]
    grain = 0.04 * fractal_noise(rng, (h, w), (h / 3, w / 3), 2)
    grain += 0.05 * fractal_noise(rng, (h, w), (3, 3), 5, 0.7)
    return finish(image * (1 + grain[..., None]))


def poster(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Bold overlapping shapes above lines of text."""
    h, w = shape
    image = np.empty((h, w, 3), np.uint8)
    image[:] = rng.uniform(150, 240, 3)
    for _ in range(22):
        shade = random_colour(rng, (0.1, 0.75), (0.15, 0.97))
        x, y = int(rng.uniform(0, w)), int(rng.uniform(0, 0.68 * h))
        size = rng.uniform(0.04, 0.22) * w
        match rng.integers(3):
            case 0:
                filled = -1 if rng.random() < 0.6 else 6
                cv2.circle(image, (x, y), int(size), shade, filled, cv2.LINE_AA)
            case 1:
                box = cv2.boxPoints(((x, y), (2 * size, size), rng.uniform(0, 90)))
                cv2.fillPoly(image, [box.astype(np.int32)], shade, cv2.LINE_AA)
            case _:
                corners = np.array([x, y]) + rng.uniform(-1.5 * size, 1.5 * size, (3, 2))
                cv2.fillPoly(image, [corners.astype(np.int32)], shade, cv2.LINE_AA)
    image[int(0.72 * h) :] = rng.uniform(190, 245, 3)
    left = int(0.07 * w)
    width = int(0.86 * w)
    _write_line(rng, image, left, int(0.82 * h), width, h // 14)
    for k in range(4):
        _write_line(rng, image, left, int((0.87 + 0.032 * k) * h), width, h // 45)
    return _print_grain(rng, image)


def landscape(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Ranges of hills under a clouded sky, nearer ones darker and rougher."""
    h, w = shape
    image = _sky(rng, shape)
    rows = np.arange(h)[:, None]
    tint = rng.uniform(0.6, 1.2, 3)
    for k in range(5):
        ridge = fractal_noise(rng, (4, w), (1, 2 + k), 7, 0.5)[0] * h * 0.05
        top = h * (0.42 + 0.12 * k) + ridge
        ground = fractal_noise(rng, shape, (12, 12), 6, 0.8)
        shade = np.array([120, 135, 110]) * tint * (1.1 - 0.17 * k)
        image = np.where((rows > top)[..., None], shade * (1 + 0.17 * ground[..., None]), image)
    return _print_grain(rng, image)


def _sky(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    height = np.linspace(0, 1, shape[0])[:, None, None]
    clouds = np.clip(fractal_noise(rng, shape, (3, 3), 7, 0.6), 0, 1.6)[..., None] / 1.6
    blue = np.array([95.0, 150, 215]) * (1 - height) + np.array([190.0, 210, 228]) * height
    return blue * (1 - clouds) + 245 * clouds


def outdoors(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Trees under the sky behind a window with glazing bars."""
    h, w = shape
    image = _sky(rng, shape)
    leaves = fractal_noise(rng, shape, (10, 10), 6, 0.85)
    crown = fractal_noise(rng, (4, w), (1, 4), 6, 0.6)[0] * 0.09 * h + 0.58 * h
    trees = np.array([88, 120, 62]) * (1 + 0.3 * leaves[..., None])
    image = np.where((np.arange(h)[:, None] > crown)[..., None], trees, image)
    image = finish(image)
    bar = max(3, w // 60)
    for k in range(4):
        x = round(k * (w - 1) / 3)
        cv2.line(image, (x, 0), (x, h), (228, 224, 214), 2 * bar)
    for k in range(3):
        y = round(k * (h - 1) / 2)
        cv2.line(image, (0, y), (w, y), (228, 224, 214), 2 * bar)
    return image


def abstract(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Contours of warped noise in a random palette, like marbled paper."""
    value = fractal_noise(rng, shape, (2, 2), 6, 0.5)
    palette = np.array([random_colour(rng, (0.1, 0.65), (0.2, 0.95)) for _ in range(9)])
    bands = np.floor(value * 2.2 + 4.5).astype(int).clip(0, 8)
    return _print_grain(rng, palette[bands])


def book_spine(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Cloth, bands and an upright title."""
    h, w = shape
    image = np.empty((w, h, 3), np.uint8)  # lying on its side, so that the title runs along it
    image[:] = random_colour(rng, (0.15, 0.65), (0.2, 0.8))
    for x in rng.uniform(0.03, 0.97, 4):
        shade = random_colour(rng, (0.1, 0.6), (0.15, 0.95))
        cv2.line(image, (int(x * h), 0), (int(x * h), w), shade, int(rng.integers(1, h // 24 + 2)))
    patch = random_colour(rng, (0.05, 0.3), (0.6, 0.95))
    cv2.rectangle(image, (int(0.2 * h), w // 8), (int(0.75 * h), w - w // 8), patch, -1)
    _write_line(rng, image, int(0.23 * h), w * 2 // 3, int(0.5 * h), max(8, w // 2))
    return _print_grain(rng, np.ascontiguousarray(np.rot90(image, int(rng.choice((-1, 1))))))


def page_edges(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """The cut edges of a block of paper."""
    lines = fractal_noise(rng, shape, (2, shape[1] / 3), 2)[..., None]
    return finish(np.array([214, 204, 182]) * (1 + 0.09 * lines))
