"""Kinds of the scenes of a batch, moving objects, and cameras that move during the exposure."""

from dataclasses import astuple, dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.camera.motion_blur import exposed, motion_while_open
from geogs_synth.clips.materials import bared, papered
from geogs_synth.clips.movers import BODIES, PARTS, people, traffic
from geogs_synth.clips.path_choice import too_near
from geogs_synth.clips.paths import Paths
from geogs_synth.clips.room_options import BARE, PAPERED, PEOPLE, STREET, RoomOptions
from geogs_synth.clips.shake import Shake, draw_shake
from geogs_synth.clips.street_clips import draw_street
from geogs_synth.draw import Draw
from geogs_synth.raycast.rendered_rooms import RenderedRooms
from geogs_synth.scene.batch import where
from geogs_synth.scene.rooms import Rooms
from geogs_synth.scene.solids import NONE, SolidBatch, Solids


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
    bodies, velocity = people(draw, rooms.size)
    if bool(street.any()):
        others, other_paths = draw_street(draw, options, b, places, materials)
        rooms, paths = where(street, others, rooms), where(street, other_paths, paths)
        cars, driving = traffic(draw, b)
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
