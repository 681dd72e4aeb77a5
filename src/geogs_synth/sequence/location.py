"""Location of a sequence: the scene, the camera's intrinsics and units that suit its size."""

import math
from dataclasses import dataclass, replace

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs_synth.motion.motion_kinds import MotionKind
from geogs_synth.motion.room_motions import Motion, room_motion
from geogs_synth.places.corridor import make_corridor, walk
from geogs_synth.places.dining_room import make_dining_room
from geogs_synth.places.moving_bodies import crossing_walkers, street_traffic
from geogs_synth.places.panelled_wall import make_panelled_wall, walk_past
from geogs_synth.places.room import make_room
from geogs_synth.places.street import drive, make_street
from geogs_synth.scene.bodies import Body
from geogs_synth.scene.textured_scene import Scene

ROOM_FOCAL = 0.7
"""Focal length over the longer side of the image in rooms: 71 degrees across."""
PANELS: dict[MotionKind, tuple[float, float]] = {
    "white-panel": (1.7, 2.0),
    "weak-link": (2.6, 0.12),
}
"""Width of the white panels and of their boards, metres: the camera sees 2.3 m."""
STREET_FOCAL = 0.58
"""The same on streets: 82 degrees across."""

_MAX_SIZE = 8192


@dataclass(frozen=True)
class Location:
    """A scene and a camera motion through it."""

    kind: MotionKind
    seed: int
    scene: Scene
    motion: Motion
    width: int = 320
    height: int = 240
    """Default height of the images, pixels."""
    focal: float = ROOM_FOCAL
    """Focal length over the longer side of the image: a phone held upright has the same lens."""
    depth_scale: float = 6553.5
    """Units of the depth images per metre."""
    voxel_cm: int = 1
    """Voxel size of the seen points, one point to a voxel, centimetres."""
    reach: float = math.inf
    """Largest depth that counts as seen, metres."""

    @property
    def name(self) -> str:
        """The place and its seed."""
        places = {"driving": "street", "corridor": "corridor", "dining": "dining room"}
        places |= dict.fromkeys(PANELS, "panelled wall")
        return f"procedural {places.get(self.kind, 'room')}, seed {self.seed}"

    def camera(self, width: int | None, height: int | None) -> Camera:
        """A camera of this or the default size, its principal point in the middle of the image."""
        return centred_camera(width or self.width, height or self.height, self.focal)

    def bodies(self, camera: Camera, seconds: float, coverage: float) -> list[Body]:
        """Moving bodies that cover about the fraction ``coverage`` of the camera's view."""
        if self.kind == "driving":
            return street_traffic(camera, coverage, self.seed)
        return crossing_walkers(self.motion.path, seconds, camera, coverage, self.seed)


def make_location(kind: MotionKind, seed: int = 0, scene: Scene | None = None) -> Location:
    """The room, dining room, street or corridor of the seed, and the motion through it.

    ``scene``, if given, is not made again.
    """
    scene = scene or make_scene(kind, seed)
    if kind == "driving":
        street = Location(
            kind, seed, scene, drive(seed), width=1241, height=376, focal=STREET_FOCAL
        )
        return replace(street, depth_scale=256.0, voxel_cm=10, reach=40.0)
    if kind == "corridor":
        motion = walk(scene, seed)
        return Location(kind, seed, scene, motion, depth_scale=2000.0, voxel_cm=2, reach=15.0)
    if kind == "white-panel" or kind == "weak-link":
        return Location(kind, seed, scene, walk_past(seed))
    motion = room_motion("handheld" if kind == "dining" else kind, scene, seed)
    return Location(kind, seed, scene, motion)


def make_scene(kind: MotionKind, seed: int = 0) -> Scene:
    """The room, dining room, street or corridor of the seed that a motion goes through."""
    if kind == "driving":
        return make_street(seed)
    if kind == "dining":
        return make_dining_room(seed)
    if kind in PANELS:
        return make_panelled_wall(*PANELS[kind], seed)
    return make_corridor(seed) if kind == "corridor" else make_room(seed)


def centred_camera(width: int, height: int, focal: float = ROOM_FOCAL) -> Camera:
    """A camera with its principal point in the middle; ``focal`` is its length over the longer
    side of the image.

    Raises:
        InputError: the image would be too small or too large.
    """
    if not (16 <= width <= _MAX_SIZE and 16 <= height <= _MAX_SIZE):
        raise InputError(f"images must be 16 to {_MAX_SIZE} pixels a side, not {width}x{height}")
    f = focal * max(width, height)
    return Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
