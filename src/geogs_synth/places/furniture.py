"""Pieces of furniture as groups of solids; sizes in metres, some drawn at random.

Each is built in a frame on the floor at the wall: x to the right along the wall, y into the room,
z up, the piece centred on x = 0.
"""

import math
from dataclasses import dataclass

import numpy as np

from geogs_synth.scene.builder import Pair, SceneBuilder, yaw_rotation
from geogs_synth.textures import artwork, patterns


@dataclass(frozen=True)
class Materials:
    """Texture indices that pieces of furniture share."""

    oak: int
    walnut: int
    lacquer: int
    metal: int
    sofa: int
    cushion: tuple[int, ...]
    ceramic: tuple[int, ...]
    leaf: int
    shade: int
    spines: tuple[int, ...]
    cloth: tuple[int, ...]
    pages: int


def make_materials(build: SceneBuilder, rng: np.random.Generator) -> Materials:
    """Draw the shared textures; their colours depend on the generator."""

    def fabric(shape: tuple[int, int], scale: float) -> int:
        ground = patterns.random_colour(rng, (0.15, 0.55), (0.35, 0.75))
        stripe = patterns.random_colour(rng, (0.1, 0.4), (0.3, 0.95))
        return build.texture(patterns.fabric(rng, shape, ground, stripe), scale)

    def ceramic() -> int:
        glaze = patterns.random_colour(rng, (0.05, 0.5), (0.5, 0.9))
        return build.texture(patterns.ceramic(rng, (160, 288), glaze))

    lacquer = patterns.random_colour(rng, (0.05, 0.3), (0.6, 0.85))
    return Materials(
        oak=build.texture(patterns.wood(rng, (256, 768), (176, 128, 82)), 0.0022),
        walnut=build.texture(patterns.wood(rng, (256, 768), (116, 76, 50)), 0.0022),
        lacquer=build.texture(patterns.wood(rng, (256, 768), lacquer), 0.0025),
        metal=build.texture(patterns.wood(rng, (128, 256), (92, 92, 96)), 0.0015),
        sofa=fabric((384, 384), 0.003),
        cushion=tuple(fabric((384, 384), 0.0016) for _ in range(4)),
        ceramic=tuple(ceramic() for _ in range(6)),
        leaf=build.texture(patterns.plaster(rng, (96, 192), (82, 128, 62))),
        shade=build.texture(patterns.fabric(rng, (128, 384), (236, 214, 170), (214, 170, 120))),
        spines=tuple(build.texture(artwork.book_spine(rng, (192, 32))) for _ in range(28)),
        cloth=tuple(fabric((96, 96), 0.002) for _ in range(5)),
        pages=build.texture(artwork.page_edges(rng, (64, 96))),
    )


def _pick(rng: np.random.Generator, options: tuple[int, ...]) -> int:
    return options[rng.integers(len(options))]


def four_legs(
    build: SceneBuilder, width: float, depth: float, height: float, thickness: float, texture: int
) -> None:
    """Legs below the corners of a top."""
    for x in (-width / 2 + thickness, width / 2 - thickness):
        for y in (thickness, depth - thickness):
            build.box((x, y, height / 2), (thickness, thickness, height), texture)


def _row_of_books(
    build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float, room: float
) -> None:
    """Upright books from x = 0 to at most ``width``, lower than ``room``, spines at y = 0."""
    x = 0.0
    while True:
        thick = rng.uniform(0.018, 0.055)
        tall = room * rng.uniform(0.62, 0.95)
        if x + thick > width:
            return
        deep = rng.uniform(0.15, 0.2)
        back = rng.uniform(0.0, 0.03)
        centre = (x + thick / 2, -back - deep / 2, tall / 2)
        cloth = _pick(rng, materials.cloth)
        spine = _pick(rng, materials.spines)
        build.box(centre, (thick, deep, tall), cloth, front=spine)
        x += thick + (rng.uniform(0.02, 0.12) if rng.random() < 0.12 else 0.001)


def _vase(build: SceneBuilder, rng: np.random.Generator, materials: Materials, size: float) -> None:
    """A thrown vase of three frustums standing on the frame's origin."""
    ceramic = _pick(rng, materials.ceramic)
    foot, belly, neck = size * rng.uniform([0.22, 0.38, 0.14], [0.3, 0.5, 0.22])
    build.frustum((0, 0, 0), (foot, belly), 0.45 * size, ceramic)
    build.frustum((0, 0, 0.45 * size), (belly, neck), 0.4 * size, ceramic)
    build.frustum((0, 0, 0.85 * size), (neck, 1.5 * neck), 0.2 * size, ceramic)


def _book_pile(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    z = 0.0
    for _ in range(rng.integers(2, 5)):
        w, d, h = rng.uniform([0.2, 0.14, 0.02], [0.28, 0.2, 0.045])
        rotation = yaw_rotation(rng.uniform(-0.4, 0.4))
        cloth = _pick(rng, materials.cloth)
        build.box((0, 0, z + h / 2), (w, d, h), cloth, front=materials.pages, rotation=rotation)
        z += h


def trinket(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A vase, a ball, a pile of books or a bowl."""
    match rng.integers(4):
        case 0:
            _vase(build, rng, materials, rng.uniform(0.14, 0.26))
        case 1:
            r = rng.uniform(0.06, 0.1)
            rotation = yaw_rotation(rng.uniform(0, 6))
            build.ellipsoid((0, 0, r), (r, r, r), _pick(rng, materials.ceramic), rotation=rotation)
        case 2:
            _book_pile(build, rng, materials)
        case _:
            r = rng.uniform(0.09, 0.13)
            build.frustum((0, 0, 0), (0.5 * r, r), 0.6 * r, _pick(rng, materials.ceramic))


def bookshelf(
    build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float
) -> None:
    """A tall open shelf with rows of books and a few objects."""
    height = rng.uniform(1.8, 2.1)
    depth = 0.32
    board = 0.025
    build.box((0, 0.01, height / 2), (width, 0.02, height), materials.lacquer)
    for side in (-1, 1):
        x = side * (width - board) / 2
        build.box((x, depth / 2, height / 2), (board, depth, height), materials.oak)
    levels = np.linspace(0.06, height - board / 2, 6)
    for z in levels:
        build.box((0, depth / 2, z), (width - 2 * board, depth, board), materials.oak)
    room = levels[1] - levels[0] - board
    inner = width - 2 * board
    for z in levels[:-1] + board / 2:
        books = inner if rng.random() < 0.5 else inner * rng.uniform(0.4, 0.7)
        row = build.at(-inner / 2, depth - 0.04, z)
        _row_of_books(row, rng, materials, books, room)
        if books < inner:
            trinket(build.at((books - 0.02) / 2, 0.18, z), rng, materials)


def sofa(build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float) -> None:
    """Seat, back, arms, cushions."""
    depth = 0.88
    seat = 0.4
    build.box((0, depth / 2 + 0.03, 0.2), (width, depth, 0.24), materials.sofa)
    build.box((0, 0.13, 0.45), (width, 0.2, 0.72), materials.sofa)
    for side in (-1, 1):
        build.box((side * (width / 2 - 0.09), 0.48, 0.38), (0.18, 0.86, 0.5), materials.sofa)
        for y in (0.1, depth - 0.06):
            build.frustum((side * (width / 2 - 0.1), y, 0), (0.02, 0.03), 0.08, materials.walnut)
    inner = width - 0.36
    for k in range(3):
        x = (k - 1) * inner / 3
        build.box((x, 0.56, seat - 0.02), (inner / 3 - 0.012, 0.68, 0.14), materials.sofa)
        lean = _pitch_rotation(0.2)
        size = (inner / 3 - 0.03, 0.14, 0.42)
        build.box((x, 0.31, seat + 0.26), size, materials.sofa, rotation=lean)
    for _ in range(3):
        x = rng.uniform(-0.4, 0.4) * inner
        pillow = _pick(rng, materials.cushion)
        rotation = yaw_rotation(rng.uniform(-0.4, 0.4)) @ _pitch_rotation(0.4)
        build.box((x, 0.5, seat + 0.2), (0.36, 0.11, 0.36), pillow, rotation=rotation)


def _pitch_rotation(angle: float) -> np.ndarray:
    """Rotation about x."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def desk(build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float) -> None:
    """A desk with drawers, a picture screen, objects, and a chair drawn up to it."""
    depth = 0.62
    height = 0.74
    build.box((0, depth / 2, height - 0.015), (width, depth, 0.03), materials.walnut)
    four_legs(build, width, depth, height - 0.03, 0.05, materials.walnut)
    side = rng.choice((-1.0, 1.0))
    x = side * (width / 2 - 0.24)
    for k in range(3):
        z = height - 0.12 - 0.17 * k
        build.box((x, depth / 2, z), (0.36, depth - 0.08, 0.16), materials.oak)
        build.ellipsoid((x, depth - 0.03, z), (0.018, 0.02, 0.018), materials.metal)
    top = build.at(-side * 0.12, 0.2, height)
    picture = build.texture(artwork.abstract(rng, (200, 320)))
    top.box((0, 0, 0.01), (0.24, 0.16, 0.02), materials.metal)
    top.box((0, 0, 0.1), (0.04, 0.03, 0.18), materials.metal)
    top.box((0, 0.02, 0.31), (0.56, 0.03, 0.35), materials.metal, front=picture)
    _row_of_books(build.at(x - 0.15, 0.3, height), rng, materials, 0.3, 0.28)
    trinket(build.at(-side * (width / 2 - 0.16), 0.36, height), rng, materials)
    chair(build.at(-side * 0.1, 0.34, yaw=rng.uniform(-0.5, 0.5)), rng, materials)


def chair(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A wooden chair that looks towards -y, its back at y = 0.42."""
    four_legs(build.at(0, 0), 0.44, 0.44, 0.44, 0.04, materials.oak)
    build.box((0, 0.22, 0.455), (0.44, 0.44, 0.03), materials.oak)
    build.box((0, 0.21, 0.485), (0.4, 0.38, 0.035), _pick(rng, materials.cushion))
    for side in (-1, 1):
        build.box((side * 0.19, 0.42, 0.7), (0.035, 0.03, 0.48), materials.oak)
    for z in (0.62, 0.74, 0.87):
        build.box((0, 0.42, z), (0.36, 0.02, 0.07), materials.oak)


def sideboard(
    build: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float
) -> None:
    """A low cabinet with doors, vases and books on top."""
    depth = 0.42
    bottom = 0.14
    height = 0.6
    four_legs(build, width, depth, bottom, 0.04, materials.metal)
    body = (width, depth, height)
    build.box((0, depth / 2, bottom + height / 2), body, materials.walnut)
    doors = 3
    for k in range(doors):
        x = (k + 0.5) * width / doors - width / 2
        size = (width / doors - 0.03, 0.02, height - 0.06)
        door = materials.oak if k % 2 else materials.lacquer
        build.box((x, depth + 0.01, bottom + height / 2), size, door)
        knob = (x + 0.35 * width / doors, depth + 0.03, bottom + 0.62 * height)
        build.ellipsoid(knob, (0.016, 0.02, 0.016), materials.metal)
    for k in range(4):
        x = (k + 0.5) * width / 4 - width / 2 + rng.uniform(-0.05, 0.05)
        spot = build.at(x, rng.uniform(0.16, 0.26), bottom + height)
        if k % 2:
            _vase(spot, rng, materials, rng.uniform(0.2, 0.38))
        else:
            trinket(spot, rng, materials)


def floor_lamp(build: SceneBuilder, materials: Materials) -> None:
    """A standing lamp that gives warm light."""
    build.frustum((0, 0, 0), (0.15, 0.13), 0.03, materials.metal)
    build.frustum((0, 0, 0.03), (0.012, 0.012), 1.3, materials.metal)
    build.frustum((0, 0, 1.26), (0.2, 0.13), 0.26, materials.shade, emission=1.0)
    build.light((0, 0, 1.4), (0.55, 0.43, 0.28), 0.12)


def plant(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A pot with a stem and flat leaves."""
    build.frustum((0, 0, 0), (0.12, 0.17), 0.3, _pick(rng, materials.ceramic))
    build.frustum((0, 0, 0.3), (0.02, 0.012), 0.45, materials.walnut)
    for k in range(16):
        yaw = 2.4 * k
        rise = rng.uniform(-0.5, 0.9)
        direction = np.array([math.cos(yaw), math.sin(yaw), 0]) * math.cos(rise)
        direction[2] = math.sin(rise)
        tilt = np.array([0, math.sin(rise), math.cos(rise)])
        centre = np.array([0, 0, 0.4 + 0.025 * k]) + 0.17 * direction
        rotation = yaw_rotation(yaw) @ _roll_rotation(-rise)
        length = rng.uniform(0.12, 0.17) * (1.05 - 0.02 * tilt[1])
        build.ellipsoid(centre, (length, 0.055, 0.008), materials.leaf, rotation=rotation)


def _roll_rotation(angle: float) -> np.ndarray:
    """Rotation about y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def round_table(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A low round table on one foot, with objects."""
    radius = rng.uniform(0.38, 0.48)
    height = rng.uniform(0.4, 0.45)
    build.frustum((0, 0, 0), (0.24, 0.2), 0.03, materials.oak)
    build.frustum((0, 0, 0.03), (0.06, 0.04), height - 0.06, materials.oak)
    build.frustum((0, 0, height - 0.03), (radius, radius), 0.03, materials.walnut)
    start = rng.uniform(0, 6)
    for k in range(3):
        angle = start + 2.1 * k
        spot = build.at(0.24 * math.cos(angle), 0.24 * math.sin(angle), height, angle)
        if k == 0:
            _vase(spot, rng, materials, 0.24)
        else:
            trinket(spot, rng, materials)


def pouf(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """A round padded stool."""
    radius = rng.uniform(0.2, 0.27)
    cloth = _pick(rng, materials.cushion)
    build.frustum((0, 0, 0.02), (radius, radius), 0.34, cloth)
    build.ellipsoid((0, 0, 0.36), (radius, radius, 0.07), cloth)


def picture(build: SceneBuilder, centre: Pair, size: Pair, canvas: int, frame: int) -> None:
    """A framed picture on the wall, its centre at (x, z); it stands off the wall by 1.5 cm."""
    x, z = centre
    w, h = size
    for side in (-1, 1):
        build.box((x + side * w / 2, 0.03, z), (0.035, 0.03, h + 0.035), frame)
        build.box((x, 0.03, z + side * h / 2), (w - 0.035, 0.03, 0.035), frame)
    build.box((x, 0.0225, z), (w, 0.015, h), frame, front=canvas)
