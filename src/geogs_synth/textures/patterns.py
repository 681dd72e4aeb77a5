"""Procedural surface textures, drawn from a random generator; nothing is downloaded.

Every function returns an RGB image of the given shape whose detail spans many scales, since the
camera is tracked by optical flow. Textures that repeat (wood, fabric, carpet) are periodic.
"""

import colorsys
import math
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

Colour = tuple[float | int, float | int, float | int]
"""RGB in 0..255."""


def random_colour(
    rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]
) -> Colour:
    """A colour of any hue with saturation and value (0..1) in the given ranges."""
    r, g, b = colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value))
    return (255 * r, 255 * g, 255 * b)


def fractal_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cells: tuple[float | int, float | int],
    octaves: int = 6,
    gain: float = 0.6,
) -> Float32[np.ndarray, "h w"]:
    """Periodic value noise of unit deviation: random lattices, each octave twice as fine (Perlin).

    ``cells`` counts the first octave's lattice cells down and across; octaves finer than a texel
    are left out. Coarse octaves are enlarged step by step, so only the last step is full size.
    """
    rows, columns = max(round(cells[0]), 1), max(round(cells[1]), 1)
    total = rng.standard_normal((rows, columns), np.float32)
    for k in range(1, octaves):
        finer = (2 * total.shape[0], 2 * total.shape[1])
        if finer[0] > shape[0] or finer[1] > shape[1]:
            break
        total = _enlarge_periodic(total, finer)
        total += gain**k * rng.standard_normal(finer, np.float32)
    total = _enlarge_periodic(total, shape)
    mean, deviation = (float(x[0, 0]) for x in cv2.meanStdDev(total))
    return (total - mean) / max(deviation, 1e-6)


def _enlarge_periodic(
    lattice: Float32[np.ndarray, "r c"], shape: tuple[int, int]
) -> Float32[np.ndarray, "h w"]:
    """Cubic enlargement whose opposite borders fit together."""
    margin = 2
    padded = np.pad(lattice, margin, mode="wrap")
    sy, sx = shape[0] / lattice.shape[0], shape[1] / lattice.shape[1]
    size = (round(padded.shape[1] * sx), round(padded.shape[0] * sy))
    large = cv2.resize(padded, size, interpolation=cv2.INTER_CUBIC)
    top, left = round(margin * sy), round(margin * sx)
    return large[top : top + shape[0], left : left + shape[1]]


def _tint(
    value: Float32[np.ndarray, "h w"], colour: Colour, contrast: float
) -> Float32[np.ndarray, "h w 3"]:
    """A colour whose brightness follows ``value`` (unit deviation) by the given fraction."""
    return np.asarray(colour, np.float32) * (1 + contrast * value[..., None])


def finish(image: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colours in 0..255 as a texture of 8 bits, neither black nor white."""
    return np.clip(image, 4, 250).astype(np.uint8)


def plaster(
    rng: np.random.Generator, shape: tuple[int, int], colour: Colour
) -> UInt8[np.ndarray, "h w 3"]:
    """Painted plaster: broad stains, trowel marks, speckles and a few cracks."""
    stains = fractal_noise(rng, shape, (3, 4), 7, 0.65)
    trowel = fractal_noise(rng, shape, (shape[0] / 12, shape[1] / 48), 2)
    speckle = fractal_noise(rng, shape, (shape[0] / 5, shape[1] / 5), 2)
    image = _tint(stains, colour, 0.07) * (1 + 0.025 * trowel + 0.03 * speckle)[..., None]
    # The coarser ground shows where the paint has worn off.
    worn = np.clip(fractal_noise(rng, shape, (4, 6), 6, 0.7) * 3 - 5, 0, 1)[..., None]
    image = image * (1 - worn) + worn * _tint(speckle, (150, 138, 122), 0.12)
    for _ in range(6):
        _crack(rng, image)
    return finish(image)


def _crack(rng: np.random.Generator, image: Float32[np.ndarray, "h w 3"]) -> None:
    h, w = image.shape[:2]
    heading = rng.uniform(0, 2 * math.pi) + np.cumsum(rng.normal(0, 0.5, 60))
    steps = np.stack([np.cos(heading), np.sin(heading)], 1) * h / 100
    path = np.cumsum(steps, 0) + rng.uniform(0, (w, h))
    shade = tuple(float(c) for c in image.mean((0, 1)) * 0.6)
    cv2.polylines(image, [path.astype(np.int32)], False, shade, 1, cv2.LINE_AA)


def brick(
    rng: np.random.Generator, shape: tuple[int, int], rows: int, colour: Colour
) -> UInt8[np.ndarray, "h w 3"]:
    """Running-bond masonry: each brick its own tone, rough mortar between."""
    height = shape[0] / rows
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    x += 1.5 * fractal_noise(rng, shape, (rows, rows), 3)
    y += 1.0 * fractal_noise(rng, shape, (rows, rows), 3)
    row = np.floor(y / height).astype(int)
    width = 3.1 * height
    shifted = x / width + 0.5 * (row % 2)
    column = np.floor(shifted).astype(int)
    table = (rows + 3, int(shape[1] / width) + 4)
    tone = rng.normal(1.0, 0.16, (*table, 1)).astype(np.float32)
    hue = rng.normal(0.0, 9.0, (*table, 3)).astype(np.float32)
    fx, fy = (shifted - column) * width, y - row * height
    edge = np.minimum(np.minimum(fx, width - fx), np.minimum(fy, height - fy))
    mask = np.clip((edge - 0.07 * height) / (0.05 * height), 0, 1)[..., None]
    grain = fractal_noise(rng, shape, (rows * 2, rows * 4), 5, 0.8)
    bricks = _tint(grain, colour, 0.11) * tone[row, column] + hue[row, column]
    mortar = _tint(fractal_noise(rng, shape, (rows * 4, rows * 6), 4, 0.9), (172, 165, 152), 0.07)
    return finish(mask * bricks + (1 - mask) * mortar)


def wallpaper(
    rng: np.random.Generator, shape: tuple[int, int], colour: Colour, cells: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Striped paper with flowers, each drawn a little differently, and stains of age."""
    h, w = shape
    stripes = np.sign(np.sin(np.arange(w) * 2 * math.pi * cells / w))[None].repeat(h, 0)
    image = _tint(stripes.astype(np.float32), colour, 0.05)
    pitch = w / cells
    flower_colour = np.asarray(colour) * rng.uniform(0.45, 0.75, 3)
    for r in range(int(h / pitch) + 2):
        for c in range(cells + 1):
            x = (c + 0.5 * (r % 2)) * pitch + rng.normal(0, 0.05 * pitch)
            _flower(rng, image, x, (r + 0.3) * pitch, pitch * rng.uniform(0.2, 0.32), flower_colour)
    image *= 1 + 0.06 * fractal_noise(rng, shape, (3, 4), 8, 0.8)[..., None]
    return finish(image)


def _flower(
    rng: np.random.Generator,
    image: Float32[np.ndarray, "h w 3"],
    x: float,
    y: float,
    radius: float,
    colour: np.ndarray,
) -> None:
    petals = int(rng.integers(4, 8))
    turn = rng.uniform(0, math.pi)
    shade = tuple(float(c) for c in np.clip(colour * rng.uniform(0.8, 1.25, 3), 0, 255))
    for k in range(petals):
        a = turn + 2 * math.pi * k / petals
        centre = (round(x + 0.55 * radius * math.cos(a)), round(y + 0.55 * radius * math.sin(a)))
        axes = (max(1, round(0.45 * radius)), max(1, round(0.2 * radius)))
        cv2.ellipse(image, centre, axes, math.degrees(a), 0, 360, shade, -1, cv2.LINE_AA)
    middle = tuple(float(255 - 0.6 * c) for c in shade)
    cv2.circle(image, (round(x), round(y)), max(1, round(0.22 * radius)), middle, -1, cv2.LINE_AA)


def wood(
    rng: np.random.Generator, shape: tuple[int, int], colour: Colour
) -> UInt8[np.ndarray, "h w 3"]:
    """Sawn wood, grain along x: warped growth rings, fine fibres and pores; periodic."""
    warp = fractal_noise(rng, shape, (2, 1), 4, 0.5)
    y = np.arange(shape[0], dtype=np.float32)[:, None] / shape[0]
    rings = np.sin(2 * math.pi * (9 * y + 0.9 * warp))
    fibres = fractal_noise(rng, shape, (shape[0] / 8, 4), 4, 0.8)
    broad = fractal_noise(rng, shape, (3, 2), 5)
    return finish(_tint(0.5 * rings + 0.6 * fibres + 0.5 * broad, colour, 0.14))


def planks(
    rng: np.random.Generator, shape: tuple[int, int], rows: int, colour: Colour
) -> UInt8[np.ndarray, "h w 3"]:
    """A board floor: boards along x, each with its own tone, grain and length."""
    edges = np.linspace(0, shape[0], rows + 1).astype(int).tolist()
    image = np.empty((*shape, 3), np.float32)
    for top, bottom in pairwise(edges):
        strip = (bottom - top, shape[1])
        fibres = fractal_noise(rng, strip, (6, 10), 4, 0.8)
        knots = fractal_noise(rng, strip, (1, 6), 5, 0.6)
        cuts = np.sort(rng.uniform(0, shape[1], 4)).astype(int)
        tone = rng.normal(1.0, 0.12, 5)[np.searchsorted(cuts, np.arange(shape[1]))]
        image[top:bottom] = _tint(fibres + 0.7 * knots, colour, 0.10) * tone[None, :, None]
        image[top : top + 2] *= 0.45
        for cut in cuts:
            image[top:bottom, cut : cut + 2] *= 0.45
    return finish(image)


def tiles(
    rng: np.random.Generator, shape: tuple[int, int], rows: int, colours: tuple[Colour, Colour]
) -> UInt8[np.ndarray, "h w 3"]:
    """Stone tiles in two colours, veined, with pale joints."""
    size = shape[0] / rows
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    row, column = (y / size).astype(int), (x / size).astype(int)
    tone = rng.normal(1.0, 0.1, (rows + 1, int(shape[1] / size) + 2, 1)).astype(np.float32)
    ground = np.asarray(colours, np.float32)[(row + column) % 2] * tone[row, column]
    veins = np.abs(fractal_noise(rng, shape, (rows, rows), 6, 0.6))
    dark = np.clip(1 - 6 * veins, 0, 1)
    cloud = fractal_noise(rng, shape, (2 * rows, 2 * rows), 6, 0.8)
    image = ground * (1 + 0.12 * cloud - 0.25 * dark)[..., None]
    fx, fy = x - column * size, y - row * size
    edge = np.minimum(np.minimum(fx, size - fx), np.minimum(fy, size - fy))
    joint = np.clip(1.5 - edge / (0.012 * size), 0, 1)[..., None]
    return finish(image * (1 - joint) + joint * np.array([168, 162, 150], np.float32))


def panels(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: tuple[float, float],
    colour: Colour,
    contrast: float,
) -> UInt8[np.ndarray, "h w 3"]:
    """Smooth painted panels of ``cell`` texels down and across.

    The narrow joints between them are darker by the fraction ``contrast`` of the colour.
    """
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    row, column = (y / cell[0]).astype(int), (x / cell[1]).astype(int)
    tone = rng.normal(1.0, 0.008, (row.max() + 1, column.max() + 1)).astype(np.float32)
    fx, fy = x - column * cell[1], y - row * cell[0]
    edge = np.minimum(np.minimum(fx, cell[1] - fx), np.minimum(fy, cell[0] - fy))
    joint = 1 - contrast * np.clip(2 - edge, 0, 1)
    return finish(np.asarray(colour, np.float32) * (tone[row, column] * joint)[..., None])


def fabric(
    rng: np.random.Generator, shape: tuple[int, int], colour: Colour, stripe: Colour
) -> UInt8[np.ndarray, "h w 3"]:
    """A woven cloth with check stripes; periodic."""
    h, w = shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    threads = np.sin(x * 2 * math.pi * (w // 8) / w) * np.sin(y * 2 * math.pi * (h // 8) / h)
    image = np.broadcast_to(np.asarray(colour, np.float32), (h, w, 3)).copy()
    for axis, length in ((y, h), (x, w)):
        for _ in range(3):
            start = rng.uniform(0, 0.8)
            width = rng.uniform(0.02, 0.12)
            inside = (axis / length > start) & (axis / length < start + width)
            image[inside] = 0.55 * image[inside] + 0.45 * np.asarray(stripe, np.float32)
    slub = fractal_noise(rng, shape, (24, 24), 4, 0.9)
    creases = fractal_noise(rng, shape, (2, 2), 6, 0.6)
    return finish(image * (1 + 0.07 * threads + 0.08 * slub + 0.08 * creases)[..., None])


def rug(rng: np.random.Generator, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """A knotted rug: nested borders, rows of motifs, a medallion, tufted pile."""
    h, w = shape
    colours = np.array([random_colour(rng, (0.2, 0.7), (0.3, 0.85)) for _ in range(7)])
    colours *= [1.0, 0.9, 0.8]
    image = np.broadcast_to(colours[0].astype(np.float32), (h, w, 3)).copy()
    for k, inset in enumerate((0.03, 0.06, 0.13, 0.15)):
        margin = int(inset * h)
        corner = (w - margin, h - margin)
        cv2.rectangle(image, (margin, margin), corner, tuple(map(float, colours[1 + k])), -1)
    pitch = h / 14
    for r in range(14):
        for c in range(round(w / pitch)):
            size = pitch * rng.uniform(0.2, 0.42)
            turn = rng.uniform(-10, 10) + 45 * (r % 2)
            box = cv2.boxPoints((((c + 0.5) * pitch, (r + 0.5) * pitch), (size, size), turn))
            shade = tuple(map(float, colours[rng.integers(7)]))
            cv2.fillPoly(image, [box.astype(np.int32)], shade, cv2.LINE_AA)
    for k in range(4):
        axes = (round((0.26 - 0.06 * k) * w), round((0.3 - 0.07 * k) * h))
        shade = tuple(map(float, colours[(k + 2) % 7]))
        cv2.ellipse(image, (w // 2, h // 2), axes, 0, 0, 360, shade, -1, cv2.LINE_AA)
    pile = fractal_noise(rng, shape, (h / 4, w / 4), 2)
    worn = fractal_noise(rng, shape, (3, 4), 6, 0.7)
    return finish(image * (1 + 0.09 * pile + 0.10 * worn)[..., None])


def ceramic(
    rng: np.random.Generator, shape: tuple[int, int], colour: Colour
) -> UInt8[np.ndarray, "h w 3"]:
    """Glazed pottery: painted bands, brush dots and crackle; periodic."""
    image = _tint(fractal_noise(rng, shape, (4, 8), 6, 0.7), colour, 0.09)
    h, w = shape
    for _ in range(5):
        top = rng.uniform(0.05, 0.9)
        shade = random_colour(rng, (0.1, 0.6), (0.3, 0.9))
        band = slice(int(top * h), int((top + rng.uniform(0.02, 0.07)) * h))
        image[band] *= np.asarray(shade, np.float32) / 170
    for _ in range(70):
        centre = (int(rng.uniform(0, w)), int(rng.uniform(0, h)))
        shade = random_colour(rng, (0.2, 0.7), (0.2, 0.95))
        cv2.circle(image, centre, int(rng.uniform(0.012, 0.04) * h), shade, -1, cv2.LINE_AA)
    return finish(image)
