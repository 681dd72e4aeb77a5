"""Kinds of scenes: moving people and cars, cameras that move while an image is taken."""

import math
from dataclasses import astuple, dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.camera.clip_camera import exposed, motion_while_open
from geogs_synth.clips.materials import bared, papered
from geogs_synth.clips.path_choice import too_near
from geogs_synth.clips.paths import Paths
from geogs_synth.clips.pieces import boxes
from geogs_synth.clips.room_options import BARE, PAPERED, PEOPLE, SHAKEN, STREET, RoomOptions
from geogs_synth.clips.street_clips import SCALE, draw_street, placed_on_street
from geogs_synth.draw import Draw, about_z
from geogs_synth.raycast.rendered_rooms import RenderedRooms
from geogs_synth.scene.batch import where
from geogs_synth.scene.rooms import Rooms
from geogs_synth.scene.solids import ELLIPSOID, FRUSTUM, NONE, SolidBatch, Solids

BODIES, PARTS = 4, 3
"""Bodies of a scene, solids of each; they are its last solids."""


@dataclass(frozen=True)
class Shake:
    """Motion of v cameras in each of b clips; the unit of time is the readout of an image."""

    rate: Float[Tensor, "b v 6"]
    """Rotation vector and translation (metres), in the frame of the camera."""
    rolling: Float[Tensor, "b"]
    """1 where rows are read one after the other, 0 where all at once."""
    exposure: Float[Tensor, "b v"]
    """Exposure time of each row."""
    objects: Float[Tensor, "b"]
    """Ratio of the readout to the time from view to view, over which objects move."""

    @property
    def sweep(self) -> Float[Tensor, "b v 6"]:
        """Motion of the cameras from their first row to their last."""
        return self.rate * self.rolling[:, None, None]


@dataclass(frozen=True)
class Dynamics:
    """Kind, camera shake and moving objects of each of b clips."""

    kind: Int[Tensor, "b"]
    """Kind of the scene, its number in :mod:`geogs_synth.clips.room_options`."""
    shake: Shake
    velocity: Float[Tensor, "b n 3"]
    """Velocity of each solid, metres from view to view."""

    def velocity_of(self, solid: Int[Tensor, "b *s"]) -> Float[Tensor, "b *s 3"]:
        """Velocity of the solids that pixels show; zero for the room itself."""
        velocity = torch.nn.functional.pad(self.velocity, (0, 0, 1, 0))
        rows = torch.arange(len(velocity), device=velocity.device)
        return velocity[rows.reshape(-1, *[1] * (solid.ndim - 1)), solid + 1]

    def out_of_the_way(self, solids: SolidBatch, views: CameraBatch) -> SolidBatch:
        """Return the solids without those that come too near to a camera on their way."""
        for step in range(1, views.T_cw.shape[1]):
            solids = solids.without(too_near(solids.moved_by(self.velocity, step), views))
        return solids

    def blurred(self, rendering: RenderedRooms, views: CameraBatch) -> Float[Tensor, "b v 3 h w"]:
        """Mean light of the views while their shutters are open."""
        shake = self.shake
        camera = shake.rate * shake.exposure[..., None]
        fraction = (shake.objects[:, None] * shake.exposure)[..., None, None, None]
        things = fraction * self.velocity_of(rendering.solid)
        return exposed(rendering.colour, motion_while_open(views, rendering.depth, camera, things))


def draw_dynamics(
    draw: Draw, options: RoomOptions, rooms: Rooms, paths: Paths, materials: int
) -> tuple[Rooms, Paths, Dynamics]:
    """Change some of the usual rooms, and their paths, into other kinds of scenes; on the host."""
    b, places = rooms.solids.kind.shape
    kind = draw.choose(astuple(options.scenes), b)
    surfaces = papered(draw, rooms.surfaces, kind == PAPERED)
    rooms = replace(rooms, surfaces=bared(draw, surfaces, kind == BARE))
    street = kind == STREET
    foot = draw.uniform(0.1, 0.9, b, BODIES, 2) * rooms.size[:, None, :2]
    bodies, velocity = _people(draw, foot, draw.chance(0.85, b, BODIES))
    if bool(street.any()):
        others, other_paths = draw_street(draw, options, b, places, materials)
        rooms = where(street, others, rooms)
        paths = where(street, other_paths, paths)
        cars, driving = _traffic(draw, b)
        bodies = where(street, cars, bodies)
        velocity = torch.where(street[:, None, None], driving, velocity)
    solids, velocity = _with_bodies(rooms.solids, bodies, velocity, (kind == PEOPLE) | street)
    shake = draw_shake(draw, kind, options.views)
    return replace(rooms, solids=solids), paths, Dynamics(kind, shake, velocity)


def _with_bodies(
    solids: SolidBatch,
    bodies: SolidBatch,
    velocity: Float[Tensor, "b k 3"],
    which: Bool[Tensor, "b"],
) -> tuple[SolidBatch, Float[Tensor, "b n 3"]]:
    """Replace the last solids of some scenes by bodies; return all solids and their velocities."""
    count = BODIES * PARTS
    rest = solids.at(torch.arange(solids.kind.shape[1] - count))
    found = where(which, Solids.join([rest, bodies]), solids)
    velocity = torch.nn.functional.pad(velocity, (0, 0, rest.kind.shape[1], 0))
    there = which[:, None] & (found.kind != NONE)
    return found, torch.where(there[..., None], velocity, 0.0)


def _people(
    draw: Draw, foot: Float[Tensor, "b k 2"], there: Bool[Tensor, "b k"]
) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    """Legs, trunk and head of people, some ``there``; the velocity of each, metres per view."""
    n = foot.shape[:2]
    tall = draw.uniform(1.2, 1.95, *n)
    wide = draw.uniform(0.13, 0.26, *n)
    x, y = foot.unbind(-1)
    parts = boxes(
        (x, y, 0.24 * tall, 0.6 * wide, 0.9 * wide, 0.24 * tall),
        (x, y, 0.65 * tall, 0.9 * wide, 1.1 * wide, 0.17 * tall),
        (x, y, 0.91 * tall, torch.tensor(0.09), torch.tensor(0.11), 0.08 * tall),
    )
    kind = torch.where(there[..., None], torch.tensor([FRUSTUM, FRUSTUM, ELLIPSOID]), NONE)
    lean = torch.nn.functional.pad(draw.normal(0.04, *n, PARTS, 2), (0, 1))
    rotation = about_z(draw.uniform(-3.15, 3.15, *n))[:, :, None].expand_as(parts.rotation)
    angle = draw.uniform(-3.15, 3.15, *n)
    pace = draw.log_uniform(0.01, 0.5, *n)[..., None] * torch.stack([angle.cos(), angle.sin()], -1)
    # Legs and head do not move quite like the trunk.
    velocity = pace[:, :, None] * draw.uniform(0.8, 1.2, *n, PARTS, 1)
    velocity = torch.nn.functional.pad(velocity, (0, 1))
    return Solids(kind, rotation, parts.centre + lean, parts.half).flatten(), velocity.flatten(1, 2)


def _traffic(draw: Draw, scenes: int) -> tuple[SolidBatch, Float[Tensor, "b parts 3"]]:
    """Cars on the roads of street clips, and pedestrians; their velocities, metres per view."""
    n = (scenes, BODIES)
    x = draw.uniform(-12, 60, *n) * (1 - 2.0 * draw.chance(0.3, *n))
    foot = torch.stack([x, draw.uniform(-7, 7, *n)], -1)
    walkers, walking = _people(draw, foot, draw.chance(0.9, *n))
    side = 1 - 2.0 * draw.integers(2, *n)
    y = side * draw.uniform(1.2, 4.5, *n)
    long, wide, tall = (draw.uniform(*r, *n) for r in ((1.6, 2.8), (0.8, 1.1), (0.6, 1.4)))
    parts = boxes(
        (x, y, 0.3 + 0.45 * tall, long, wide, 0.45 * tall),
        (x - 0.2 * long, y, 0.3 + 1.1 * tall, 0.6 * long, 0.9 * wide, 0.35 * tall),
        (x, y, 0.15 + 0.15 * tall, 0.9 * long, 1.02 * wide, 0.15 * tall),
    )
    rotation = about_z(draw.normal(0.05, *n))[:, :, None].expand_as(parts.rotation)
    ahead = draw.log_uniform(0.03, 3.0, *n) * torch.where(draw.chance(0.8, *n), -side, side)
    driving = torch.nn.functional.pad(ahead.repeat_interleave(PARTS, 1)[..., None], (0, 2))
    kind = torch.where(draw.chance(0.9, *n)[..., None], parts.kind, NONE)
    cars = replace(parts, kind=kind, rotation=rotation).flatten()
    is_car = draw.chance(0.65, *n).repeat_interleave(PARTS, 1)
    velocity = torch.where(is_car[..., None], driving, walking)
    return placed_on_street(where(is_car, cars, walkers)), SCALE * velocity


def draw_shake(draw: Draw, kind: Int[Tensor, "b"], views: int) -> Shake:
    """Draw motion for shaken clips and for some of the kinds after it, none for usual ones."""
    b, n = len(kind), (len(kind), views)
    shaken = (kind == SHAKEN) | ((kind > SHAKEN) & draw.chance(0.4, b))
    street = (kind == STREET)[:, None, None]

    def vary(size: Tensor) -> Tensor:
        """Random values of this size, similar in the views of a clip."""
        whole = 0.6 * draw.normal(1.0, b, 1, 3) + 0.8 * draw.normal(1.0, *n, 3)
        return size[:, None, None] * whole

    # During the readout: degrees about each axis; metres along each in rooms, and ahead on streets.
    rotation = vary(draw.log_uniform(0.15, 2.5, b) * (math.pi / 180))
    translation = vary(draw.log_uniform(0.001, 0.02, b))
    ahead = draw.log_uniform(0.01, 0.06, b)[:, None, None] * draw.uniform(0.8, 1.2, *n, 1)
    ahead = torch.nn.functional.pad(ahead, (2, 0)) + 0.2 * translation
    # Cars turn slowly.
    rotation = torch.where(street, 0.3 * rotation, rotation)
    translation = torch.where(street, ahead, translation)
    rate = torch.cat([rotation, translation], -1) * shaken[:, None, None]
    long = draw.log_uniform(0.1, 1.0, b, 1) * draw.uniform(0.7, 1.3, *n)
    return Shake(
        rate=rate,
        rolling=(shaken & draw.chance(0.8, b)).float(),
        exposure=long * (shaken & draw.chance(0.8, b))[:, None],
        objects=draw.log_uniform(0.02, 0.4, b),
    )
