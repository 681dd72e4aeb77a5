"""Many furnished rooms in a ring, with doors between neighbours, and a walk through all of them.

Two rows of rooms lie back to back; the walk leads along one and back along the other. Every room
is drawn from the seed and its index, so that one can be made without the others.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline

from geogs.errors import InputError
from geogs_synth.motion.handheld import look_at, with_shake
from geogs_synth.places import furniture
from geogs_synth.places.furniture import Materials
from geogs_synth.places.room import add_ceiling_and_floor, add_ceiling_lamp, add_picture, wall_image
from geogs_synth.scene.builder import SceneBuilder
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.textures import patterns

ROOM = np.array([5.0, 4.4, 2.6])
"""Width, depth and height of a room, metres."""
WALL = 0.2
"""Thickness of the walls between rooms, metres."""
DOOR_WIDTH, DOOR_HEIGHT = 1.1, 2.1
STEP = 0.022
"""Distance between the camera's positions in two frames, metres."""
_ASIDE = 0.6
_AHEAD = 1.5
_SWAY, _SWAY_LENGTH = 0.7, 4.3
_LENGTH_PER_ROOM = 5.6


@dataclass(frozen=True)
class Door:
    """An opening in a wall: 0 south, 1 east, 2 north, 3 west."""

    wall: int
    aside: float
    """Metres from the middle of the wall, towards +x or +y of the room."""
    to: int
    """Index of the room behind it."""


@dataclass(frozen=True)
class Suite:
    """A ring of ``rooms`` rooms, an even number of at least 4."""

    rooms: int
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rooms < 4 or self.rooms % 2:
            raise InputError(f"a suite has an even number of at least 4 rooms, not {self.rooms}")

    @staticmethod
    def for_walk(frames: int, seed: int = 0) -> "Suite":
        """The suite that a walk of ``frames`` goes round once, to end where it began.

        About a tenth of the frames see the first rooms again, unless there are few frames.
        """
        rooms = 2 * round(0.9 * frames * STEP / _LENGTH_PER_ROOM / 2)
        return Suite(max(rooms, 4), seed)

    def cell(self, room: int) -> tuple[int, int]:
        """Column and row of a room."""
        columns = self.rooms // 2
        room %= self.rooms
        return (room, 0) if room < columns else (self.rooms - 1 - room, 1)

    def origin(self, room: int) -> Float64[np.ndarray, "3"]:
        """World position of the corner of a room."""
        column, row = self.cell(room)
        return np.array([column * (ROOM[0] + WALL), row * (ROOM[1] + WALL), 0.0])

    def doors(self, room: int) -> tuple[Door, Door]:
        """Doors to the previous and to the next room."""
        return (self._door(room, room - 1, room - 1), self._door(room, room + 1, room))

    def _door(self, room: int, other: int, number: int) -> Door:
        (x, y), (u, v) = self.cell(room), self.cell(other)
        wall = {(1, 0): 1, (-1, 0): 3, (0, 1): 2, (0, -1): 0}[u - x, v - y]
        number %= self.rooms
        # Doors alternate sides, so that one does not see through all of them.
        aside = _ASIDE * (-1) ** number * np.random.default_rng([self.seed, number]).uniform(0.6, 1)
        return Door(wall, float(aside), other % self.rooms)

    def door_centre(self, room: int, door: Door) -> Float64[np.ndarray, "2"]:
        """Centre of a door, in the middle of the wall's thickness, world."""
        middle, out = ROOM[:2] / 2, _outward(door.wall)
        along = np.abs(out[::-1]) * door.aside
        return self.origin(room)[:2] + middle + out * (middle + WALL / 2) + along

    def room(self, room: int) -> Scene:
        """A furnished room in its own frame, open at its doors, with the passage to the next."""
        rng = np.random.default_rng([self.seed, room % self.rooms, 0x5017])
        build = SceneBuilder(rng)
        materials = furniture.make_materials(build, rng)
        doors = {door.wall: door for door in self.doors(room)}
        add_ceiling_and_floor(build, rng, ROOM, materials)
        mains = list(rng.permutation(4))
        for wall in range(4):
            frame, width = _wall_frame(build, wall)
            if wall in doors:
                gap = doors[wall].aside * (1 if wall in (0, 1) else -1)
                _open_wall(frame, rng, width, gap)
                _beside_door(frame, rng, materials, width, gap)
            else:
                _closed_wall(frame, rng, width)
                _main_piece(frame, rng, materials, width, int(mains.pop()))
            if wall in doors and doors[wall].to == (room + 1) % self.rooms:
                _passage(frame, materials, gap)
        _middle(build, rng, materials)
        return build.build(ROOM)

    def nearest(self, point: Float64[np.ndarray, "3"]) -> int:
        """Index of the room that a point lies in, or is nearest to."""
        column = int(np.clip(round((point[0] - ROOM[0] / 2) / (ROOM[0] + WALL)), 0, None))
        row = int(np.clip(round((point[1] - ROOM[1] / 2) / (ROOM[1] + WALL)), 0, 1))
        column = min(column, self.rooms // 2 - 1)
        return column if row == 0 else self.rooms - 1 - column

    def walk(self, frames: int, pace: float = 1.0) -> Float64[np.ndarray, "n 4 4"]:
        """Camera-to-world poses round the ring, again and again; shorter walks begin longer ones.

        From one frame to the next the camera moves ``pace`` times ``STEP``. It looks along its path
        and from side to side, at eye level, with a little shake.
        """
        path = _closed_path(self._waypoints())
        length = float(path.x[-1])
        s = pace * STEP * np.arange(frames)
        position, ahead = path(s % length), path((s + _AHEAD) % length)
        direction = ahead - position
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        sideways = np.stack([-direction[:, 1], direction[:, 0]], 1)
        sway = _SWAY * np.sin(2 * np.pi * s / _SWAY_LENGTH)[:, None]
        target = position + _AHEAD * direction + sway * sideways
        height = 1.52 + 0.06 * np.sin(2 * np.pi * s / 3.1)
        looked = 1.22 + 0.12 * np.sin(2 * np.pi * s / 5.3)
        T_wc = look_at(np.column_stack([position, height]), np.column_stack([target, looked]))
        return with_shake(T_wc, self.seed, np.arange(frames))

    def _waypoints(self) -> Float64[np.ndarray, "n 2"]:
        """Waypoints round the ring, from the middle of the first room."""
        points: list[np.ndarray] = []
        for room in range(self.rooms):
            rng = np.random.default_rng([self.seed, room, 0xA7])
            middle = self.origin(room)[:2] + ROOM[:2] / 2
            before, after = self.doors(room)
            across = np.abs(_outward(after.wall)[::-1])
            bend = rng.choice((-1.0, 1.0)) * rng.uniform(0.5, 0.8)
            inside = middle + bend * across + rng.uniform(-0.25, 0.25, 2)
            entry, exit = self.door_centre(room, before), self.door_centre(room, after)
            if room > 0:
                points.append(entry - 0.7 * _outward(before.wall))
            points += [inside, exit - 0.7 * _outward(after.wall), exit]
        before = self.doors(0)[0]
        points.append(self.door_centre(0, before) - 0.7 * _outward(before.wall))
        return np.array(points)


def _outward(wall: int) -> Float64[np.ndarray, "2"]:
    return np.array([(0, -1), (1, 0), (0, 1), (-1, 0)][wall], float)


def _closed_path(points: Float64[np.ndarray, "n 2"]) -> CubicSpline:
    """A smooth closed path through the points, approximately by arc length."""
    closed = np.concatenate([points, points[:1]])
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    rough = CubicSpline(chord, closed, bc_type="periodic")
    dense = np.linspace(0, chord[-1], 100 * len(closed))
    at = rough(dense)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
    at[-1] = at[0]
    return CubicSpline(length, at, bc_type="periodic")


def _wall_frame(build: SceneBuilder, wall: int) -> tuple[SceneBuilder, float]:
    """Frame of a wall (x along it as seen from behind, y into the room), and the wall's width."""
    w, d, _ = ROOM
    place = [(w / 2, 0.0), (w, d / 2), (w / 2, d), (0.0, d / 2)][wall]
    return build.at(*place, yaw=wall * math.pi / 2), float(w if wall % 2 == 0 else d)


def _papered(
    frame: SceneBuilder, image: np.ndarray, width: float, a: float, b: float, low: float
) -> None:
    """Add the part of a wall from x = a to b and from ``low`` to the ceiling, with its part of the
    paper."""
    h, (rows, columns) = float(ROOM[2]), image.shape[:2]
    left, right = (round(columns * (width / 2 - x) / width) for x in (b, a))
    part = image[: max(round(rows * (h - low) / h), 2), left : max(right, left + 2)]
    upright = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    paper = frame.texture(np.ascontiguousarray(part))
    frame.rectangle(((a + b) / 2, 0, (h + low) / 2), (b - a, h - low), paper, upright)


def _closed_wall(frame: SceneBuilder, rng: np.random.Generator, width: float) -> None:
    image = wall_image(rng, int(rng.integers(4)), width, float(ROOM[2]))
    _papered(frame, image, width, -width / 2, width / 2, 0.0)


def _open_wall(frame: SceneBuilder, rng: np.random.Generator, width: float, gap: float) -> None:
    """A wall with an opening whose middle is at x = gap."""
    image = wall_image(rng, int(rng.integers(4)), width, float(ROOM[2]))
    a, b = gap - DOOR_WIDTH / 2, gap + DOOR_WIDTH / 2
    _papered(frame, image, width, -width / 2, a, 0.0)
    _papered(frame, image, width, b, width / 2, 0.0)
    _papered(frame, image, width, a, b, DOOR_HEIGHT)


def _passage(frame: SceneBuilder, materials: Materials, gap: float) -> None:
    """Jambs, lintel and threshold through the thickness of the wall."""
    for side in (-1, 1):
        x = gap + side * (DOOR_WIDTH / 2 + 0.03)
        frame.box((x, -WALL / 2, DOOR_HEIGHT / 2), (0.06, WALL + 0.06, DOOR_HEIGHT), materials.oak)
    wide = (DOOR_WIDTH + 0.12, WALL + 0.06, 0.06)
    frame.box((gap, -WALL / 2, DOOR_HEIGHT + 0.03), wide, materials.oak)
    frame.box((gap, -WALL / 2, -0.02), (DOOR_WIDTH, WALL, 0.05), materials.walnut)


def _beside_door(
    frame: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float, gap: float
) -> None:
    """Pictures on both sides, something in the farther corner."""
    for side in (-1.0, 1.0):
        edge = gap + side * DOOR_WIDTH / 2
        middle = (edge + side * width / 2) / 2
        add_picture(frame, rng, materials, float(middle), rng.uniform(1.45, 1.65), 0.5)
    corner = frame.at(-math.copysign(width / 2 - 0.42, gap), 0.42)
    match rng.integers(3):
        case 0:
            furniture.plant(corner, rng, materials)
        case 1:
            furniture.pouf(corner, rng, materials)
        case _:
            furniture.floor_lamp(corner, materials)


def _main_piece(
    frame: SceneBuilder, rng: np.random.Generator, materials: Materials, width: float, kind: int
) -> None:
    """A shelf, a sofa, a desk or a sideboard at a wall, pictures beside or above."""
    piece = frame.at(rng.uniform(-0.3, 0.3), 0.02)
    if kind == 0:
        furniture.bookshelf(piece, rng, materials, rng.uniform(1.3, 1.8))
        places: tuple[float, ...] = (-width / 2 + 0.55, width / 2 - 0.55)
    else:
        make = (furniture.sofa, furniture.desk, furniture.sideboard)[kind - 1]
        make(piece, rng, materials, rng.uniform(1.5, 1.9))
        places = (-0.85, 0.0, 0.85) if kind != 2 else (-width / 2 + 0.6, width / 2 - 0.6)
    for x in places:
        add_picture(frame, rng, materials, x, rng.uniform(1.45, 1.65), 0.52)


def _middle(build: SceneBuilder, rng: np.random.Generator, materials: Materials) -> None:
    """Rug, round table, the ceiling lamp."""
    w, d = ROOM[:2]
    middle = build.at(w / 2, d / 2, yaw=rng.uniform(-0.3, 0.3))
    middle.box((0, 0, 0.006), (2.3, 1.65, 0.012), build.texture(patterns.rug(rng, (512, 720))))
    x, y = rng.uniform(-0.5, 0.5, 2)
    furniture.round_table(middle.at(x, y, 0.012), rng, materials)
    add_ceiling_lamp(build, ROOM, materials)
