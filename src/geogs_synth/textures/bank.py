"""Makes the textures of the rooms: drawn ones, noise, and crops of scikit-image's photographs."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import skimage
import torch
from jaxtyping import UInt8
from PIL import Image

from geogs_synth.textures import artwork, patterns
from geogs_synth.textures.patterns import Colour
from geogs_synth.textures.pyramids import TextureBank

Recipe = Callable[[np.random.Generator, int], UInt8[np.ndarray, "s s 3"]]

TRAINING_PHOTOGRAPHS = (
    "astronaut.png", "coffee.png", "rocket.jpg", "hubble_deep_field.jpg", "coins.png", "brick.png",
    "grass.png", "ihc.png", "camera.png", "page.png",
)  # fmt: skip
VALIDATION_PHOTOGRAPHS = ("chelsea.png", "gravel.png", "moon.png", "text.png", "retina.jpg")
_MATERIALS = 0.6
"""Fraction of the bank that is materials rather than images."""
_LEAST_DRAWN = 192
"""Least side of a drawn texture, texels; smaller ones are reduced from it."""


def make_bank(
    count: int, size: int, seed: int, device: torch.device, validation: bool = False
) -> TextureBank:
    """``count`` textures of ``size`` x ``size``, all periodic; drawn on all processor cores."""
    if size & (size - 1):
        raise ValueError(f"The side of a texture must be a power of two, not {size}.")
    materials = max(1, round(_MATERIALS * count))

    def make(index: int) -> UInt8[np.ndarray, "s s 3"]:
        rng = np.random.default_rng([seed, int(validation), index])
        material = index < materials
        recipe = _material(rng) if material else _image(rng, index - materials, validation)
        return _periodic(recipe, rng, size)

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        images = list(pool.map(make, range(count)))
    return TextureBank.pack(torch.from_numpy(np.stack(images)).to(device), materials)


def _periodic(recipe: Recipe, rng: np.random.Generator, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """An image whose opposite borders fit, by fading the part beyond one into the other."""
    drawn = max(size, _LEAST_DRAWN)
    margin = drawn // 8
    image = recipe(rng, drawn + margin).astype(np.float32)
    fade = np.linspace(0, 1, margin, dtype=np.float32)[:, None, None]
    for _ in range(2):  # down, then across
        image[:margin] = fade * image[:margin] + (1 - fade) * image[drawn:]
        image = image[:drawn].transpose(1, 0, 2).copy()
    reduced = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    return np.clip(reduced + 0.5, 0, 255).astype(np.uint8)


def _material(rng: np.random.Generator) -> Recipe:
    recipes: tuple[Recipe, ...] = (
        _noise,
        _noise,
        _noise,
        lambda rng, s: patterns.plaster(rng, (s, s), _paint(rng)),
        lambda rng, s: patterns.brick(rng, (s, s), int(rng.integers(4, 14)), _paint(rng)),
        lambda rng, s: patterns.wallpaper(rng, (s, s), _paint(rng), int(rng.integers(3, 9))),
        lambda rng, s: patterns.wood(rng, (s, s), _timber(rng)),
        lambda rng, s: patterns.wood(rng, (s, s), _paint(rng)),
        lambda rng, s: patterns.planks(rng, (s, s), int(rng.integers(3, 9)), _timber(rng)),
        lambda rng, s: patterns.tiles(rng, (s, s), int(rng.integers(2, 9)), _pair(rng)),
        lambda rng, s: patterns.fabric(rng, (s, s), *_pair(rng)),
    )
    return recipes[rng.integers(len(recipes))]


def _image(rng: np.random.Generator, index: int, validation: bool) -> Recipe:
    """A photograph for every second image, a drawing for the others."""
    if index % 2 == 0:
        names = VALIDATION_PHOTOGRAPHS if validation else TRAINING_PHOTOGRAPHS
        name = names[index // 2 % len(names)]
        if _photograph(name) is not None:
            return lambda rng, s: _crop(rng, name, s)
    recipes: tuple[Recipe, ...] = (
        lambda rng, s: patterns.rug(rng, (s, s)),
        lambda rng, s: patterns.ceramic(rng, (s, s), _paint(rng)),
        lambda rng, s: artwork.poster(rng, (s, s)),
        lambda rng, s: artwork.poster(rng, (s, s)),
        lambda rng, s: artwork.landscape(rng, (s, s)),
        lambda rng, s: artwork.outdoors(rng, (s, s)),
        lambda rng, s: artwork.abstract(rng, (s, s)),
        _books,
        _books,
        lambda rng, s: artwork.page_edges(rng, (s, s)),
    )
    return recipes[rng.integers(len(recipes))]


def _paint(rng: np.random.Generator) -> Colour:
    return patterns.random_colour(rng, (0.0, 0.75 * float(rng.random()) ** 1.5), (0.3, 0.95))


def _pair(rng: np.random.Generator) -> tuple[Colour, Colour]:
    return _paint(rng), _paint(rng)


def _timber(rng: np.random.Generator) -> Colour:
    shade = rng.uniform(0.5, 1.3)
    return shade * 170, shade * rng.uniform(105, 140), shade * rng.uniform(60, 115)


def _books(rng: np.random.Generator, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """Rows of book spines."""
    rows = int(rng.integers(1, 4))
    across = int(rng.integers(5, 11))
    shape = (max(48, size // rows), max(12, size // across))
    lines = [
        np.concatenate([artwork.book_spine(rng, shape) for _ in range(across)], 1)
        for _ in range(rows)
    ]
    return cv2.resize(np.concatenate(lines), (size, size), interpolation=cv2.INTER_AREA)


def _noise(rng: np.random.Generator, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """Clouds, speckles or blotches of two colours, from one scale or many."""
    cells = np.exp(rng.uniform(0.7, np.log(size / 4)))
    gain = rng.uniform(0.45, 1.0)
    stretch = np.exp(rng.uniform(-1.5, 1.5)) if rng.random() < 0.4 else 1.0
    lattice = (max(1.0, cells * stretch), max(1.0, cells / stretch))
    value = patterns.fractal_noise(rng, (size, size), lattice, int(rng.integers(1, 8)), gain)
    if rng.random() < 0.4:  # blotches with edges
        value = np.clip(value * np.exp(rng.uniform(0.5, 2.5)), -1, 1)
    first, second = (np.asarray(_paint(rng), np.float32) for _ in range(2))
    if rng.random() < 0.5:  # shades of one colour
        second = first * rng.uniform(0.2, 0.8)
    mix = np.clip(0.5 + 0.33 * value, 0, 1)[..., None]
    return np.clip(first * mix + second * (1 - mix), 0, 255).astype(np.uint8)


def _crop(rng: np.random.Generator, name: str, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """A square of a photograph, mirrored and dyed at random."""
    image = _photograph(name)
    assert image is not None
    side = int(min(image.shape[:2]) * rng.uniform(0.35, 1.0))
    top, left = (int(rng.integers(0, length - side + 1)) for length in image.shape[:2])
    square = image[top : top + side, left : left + side]
    if rng.random() < 0.3:
        square = square[..., rng.permutation(3)]
    if rng.random() < 0.5:
        square = square[:, ::-1]
    mode = cv2.INTER_AREA if side > size else cv2.INTER_CUBIC
    return cv2.resize(np.ascontiguousarray(square), (size, size), interpolation=mode)


@cache
def _photograph(name: str) -> UInt8[np.ndarray, "h w 3"] | None:
    """A picture that comes with scikit-image; None where it was left out."""
    path = Path(skimage.__file__).parent / "data" / name
    return np.asarray(Image.open(path).convert("RGB")) if path.is_file() else None
