"""Streets: houses, parked cars, trees and posts along a road, under a sky that is far away.

A street is a room whose walls and ceiling are the sky. Lengths are a fifth of the real ones, so
that the constants of rooms (clearances, softness of light) hold here.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from geogs_synth.clips.furnishing import Furnishing
from geogs_synth.clips.lights import MOST_LIGHTS
from geogs_synth.clips.materials import draw_surfaces
from geogs_synth.clips.paths import Paths, draw_intrinsics, looking
from geogs_synth.clips.room_options import RoomOptions
from geogs_synth.draw import Draw, rotation_matrix
from geogs_synth.scene.rooms import Lights, Rooms, Surfaces
from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM, NONE, SolidBatch, Solids, upright

SCALE = 0.2
_SIZE = (300.0, 300.0, 120.0)
"""Size of the room that is the world, units."""
_MIDDLE = (150.0, 150.0, 0.0)
"""A point of the road, which runs along x."""
_HOUSES, _CARS, _TREES, _POSTS = 22, 12, 6, 12
_SUN = 100.0
"""Distance of the sun, units."""


def draw_street(
    draw: Draw, options: RoomOptions, count: int, places: int, materials: int
) -> tuple[Rooms, Paths]:
    """``count`` streets of ``places`` solids (some empty), and candidate paths along them."""
    size = torch.tensor(_SIZE).expand(count, 3).clone()
    solids = _solids(draw, count, places)
    layout = Furnishing(solids, torch.arange(places), torch.zeros(places, dtype=torch.bool))
    surfaces = _surfaces(draw, draw_surfaces(draw, layout, options.textures, materials))
    rooms = Rooms(size, solids, surfaces, _lights(draw, count, options.views))
    return rooms, _paths(draw, options, count)


def _solids(draw: Draw, b: int, places: int) -> SolidBatch:
    """All solids of a street."""
    parts = [*_houses(draw, b), _cars(draw, b), _trees(draw, b), _posts(draw, b)]
    solids = Solids.join(parts)
    empty = places - solids.kind.shape[1]
    rest = upright(torch.full((b, empty), NONE), torch.zeros(b, empty, 3), torch.ones(b, empty, 3))
    return placed_on_street(Solids.join([solids, rest]))


def placed_on_street(solids: SolidBatch) -> SolidBatch:
    """Scale and move solids that are given in metres around a point of the road."""
    middle = torch.tensor(_MIDDLE)
    return replace(solids, centre=SCALE * solids.centre + middle, half=SCALE * solids.half)


def _houses(draw: Draw, b: int) -> list[SolidBatch]:
    """Fronts on both sides, some with gaps between them, and pavements."""
    rows = []
    for side in (-1, 1):
        n = (b, _HOUSES // 2)
        long = draw.uniform(4, 13, *n)
        gap = draw.uniform(0, 3, *n) * draw.chance(0.3, *n)
        x = 2 * long.cumsum(-1) - long + gap.cumsum(-1) - draw.uniform(20, 60, b, 1)
        deep = draw.uniform(3, 8, *n)
        tall = draw.uniform(2, 14, *n)
        line = draw.uniform(5, 14, b, 1)
        front = line + draw.uniform(0, 1.5, *n) * draw.chance(0.4, *n)
        half = torch.stack([long, deep, tall], -1)
        centre = torch.stack([x, side * (front + deep), tall], -1)
        rows.append(_some(BOX, draw.chance(0.92, *n), centre, half))
        kerb = torch.tensor([250.0, 1.6, 0.08]).expand(b, 1, 3)
        at = torch.stack([torch.zeros(b, 1), side * (line - 1.6), torch.full((b, 1), 0.08)], -1)
        rows.append(_some(BOX, draw.chance(0.7, b, 1), at, kerb))
    return rows


def _cars(draw: Draw, b: int) -> SolidBatch:
    """Parked cars: a body and a cabin above it."""
    n = (b, _CARS)
    half = torch.stack(
        [draw.uniform(1.7, 2.6, *n), draw.uniform(0.8, 1.0, *n), draw.uniform(0.4, 0.6, *n)], -1
    )
    side = 1 - 2.0 * draw.integers(2, *n)
    at = torch.stack(
        [draw.uniform(-15, 70, *n), side * draw.uniform(3.5, 6.5, *n), half[..., 2] + 0.2], -1
    )
    top = half * torch.tensor([0.55, 0.9, 0.7])
    above = at + torch.nn.functional.pad((half + top)[..., 2:], (2, 0))
    there = draw.chance(0.5, *n)
    return Solids.join([_some(BOX, there, at, half), _some(BOX, there, above, top)])


def _trees(draw: Draw, b: int) -> SolidBatch:
    n = (b, _TREES)
    x, y = draw.uniform(-10, 60, *n), draw.uniform(4, 9, *n) * (1 - 2.0 * draw.integers(2, *n))
    stem = draw.uniform(1.0, 2.5, *n)
    radius = draw.uniform(0.1, 0.25, *n)
    crown = draw.uniform(0.8, 3.0, *n, 3)
    foot = torch.stack([x, y, stem], -1)
    top = torch.stack([x, y, 2 * stem + 0.8 * crown[..., 2]], -1)
    there = draw.chance(0.5, *n)
    trunk = torch.stack([radius, 0.8 * radius, stem], -1)
    return Solids.join([_some(FRUSTUM, there, foot, trunk), _some(ELLIPSOID, there, top, crown)])


def _posts(draw: Draw, b: int) -> SolidBatch:
    """Lamp posts, signs' posts, bollards."""
    n = (b, _POSTS)
    tall = draw.log_uniform(0.4, 4.0, *n)
    radius = draw.log_uniform(0.03, 0.15, *n)
    y = draw.uniform(4, 8, *n) * (1 - 2.0 * draw.integers(2, *n))
    at = torch.stack([draw.uniform(-8, 50, *n), y, tall], -1)
    half = torch.stack([radius, radius, tall], -1)
    return _some(FRUSTUM, draw.chance(0.6, *n), at, half)


def _some(kind: int, there: Tensor, centre: Tensor, half: Tensor) -> SolidBatch:
    """Upright solids of a kind; those that are not ``there`` are empty."""
    return upright(torch.where(there, kind, NONE), centre, half)


def _surfaces(draw: Draw, surfaces: Surfaces) -> Surfaces:
    """A sky that shines by itself, ground with grain, fronts that show an image."""
    b, s = surfaces.contrast.shape
    face = torch.arange(s)
    sky = ((face < 6) & (face != 4)).expand(b, s)
    ground = (face == 4).expand(b, s)
    house = ((face >= 6) & (face < 6 + 2 * (_HOUSES + 2))).expand(b, s)
    # One sky, whatever wall it is on.
    wide = 1 / draw.log_uniform(100.0, 400.0, b, 1)
    scale = surfaces.matrix[..., 0].norm(dim=-1)
    wanted = torch.where(sky, wide, torch.where(ground, 3 * scale, scale))
    clouds = (draw.chance(0.7, b, 1) * draw.uniform(0.0, 0.5, b, 1)).expand(b, s)
    blue = draw.uniform(0.0, 0.35, b, 1, 1) * torch.tensor([-1.0, 0.0, 1.0]) + 1
    tint = (draw.uniform(1.0, 1.8, b, 1, 1) * blue).expand(b, s, 3)
    texture = torch.where(sky, surfaces.texture[:, :1], surfaces.texture)
    shown = torch.where(
        house & draw.chance(0.8, b, s), surfaces.contrast.clamp_min(0.3), surfaces.contrast
    )
    grain = torch.where(ground, draw.log_uniform(0.05, 0.5, b, 1), surfaces.detail)
    return replace(
        surfaces,
        texture=texture,
        matrix=surfaces.matrix * (wanted / scale)[..., None, None],
        contrast=torch.where(sky, clouds, shown),
        detail=torch.where(sky, 0.0, grain),
        tint=torch.where(sky[..., None], tint, surfaces.tint),
        glow=torch.where(sky, draw.log_uniform(0.7, 4.0, b, 1), surfaces.glow),
        gloss=torch.where(sky, 0.0, surfaces.gloss),
        mirror=torch.where(sky | ground, 0.0, surfaces.mirror),
    )


def _lights(draw: Draw, b: int, views: int) -> Lights:
    """A sun, or none, and the sky."""
    round_ = draw.uniform(-3.15, 3.15, b)
    up = draw.uniform(0.25, 1.3, b)
    way = torch.stack([round_.cos() * up.cos(), round_.sin() * up.cos(), up.sin()], -1)
    position = torch.zeros(b, MOST_LIGHTS, 3) + torch.tensor([0.0, 0.0, 50.0])
    position[:, 0] = torch.tensor(_MIDDLE) + _SUN * way
    power = draw.chance(0.6, b) * draw.log_uniform(0.7, 5.0, b) * _SUN**2
    colour = torch.zeros(b, MOST_LIGHTS, 3)
    colour[:, 0] = power[:, None] * (1 + 0.1 * torch.tensor([1.0, 0.2, -1.0]))
    above = draw.uniform(0.5, 1.5, b, 1) * torch.tensor([0.95, 1.0, 1.1])
    per_view = (position, colour, torch.full((b, MOST_LIGHTS), 0.5), above, 0.5 * above)
    return Lights(*(x[:, None].expand(b, views, *x.shape[1:]).contiguous() for x in per_view))


def _paths(draw: Draw, options: RoomOptions, b: int) -> Paths:
    """Driving ahead, walking, and turning; candidates of a street all move in the same manner."""
    k = options.candidates
    v = options.views
    start = torch.stack(
        [draw.uniform(-6, 6, b, k), draw.uniform(-3.5, 3.5, b, k), draw.uniform(1.1, 2.2, b, k)], -1
    )
    start = SCALE * start + torch.tensor(_MIDDLE)
    way = draw.choose((0.6, 0.25, 0.15), b)[:, None].expand(b, k)  # drives, walks, turns
    drives = way == 0
    turns = way == 2
    yaw = torch.where(drives, draw.normal(0.06, b, k), draw.uniform(-3.15, 3.15, b, k))
    pitch = draw.normal(0.06, b, k)
    forward = torch.stack([yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), pitch.sin()], -1)
    length = torch.where(
        drives,
        draw.log_uniform(0.25, 3.5, b, k),
        torch.where(turns, 0.01, draw.log_uniform(0.05, 0.8, b, k)),
    )
    along = torch.stack([torch.ones(b, k), draw.normal(0.02, b, k), draw.normal(0.01, b, k)], -1)
    across = torch.nn.functional.normalize(draw.normal(1.0, b, k, 3), dim=-1)
    move = SCALE * length[..., None] * torch.where(drives[..., None], along, across)
    most = torch.where(drives, 2.0, torch.where(turns, 18.0, 5.0))[..., None] * (math.pi / 180)
    spin = draw.uniform(-1, 1, b, k, 3) * torch.tensor([0.4, 1.0, 0.2]) * most
    progress = torch.arange(v) / max(math.sqrt(v - 1), 1.0)
    centre = start[:, :, None] + progress[:, None] * move[:, :, None]
    R = looking(forward)[:, :, None] @ rotation_matrix(progress[:, None] * spin[:, :, None])
    return Paths(R, centre, draw_intrinsics(draw, options, b), torch.zeros(b))
