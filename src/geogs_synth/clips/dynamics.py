"""What is unusual in a batch of scenes: kinds, things that move, cameras that move as they look."""

from dataclasses import astuple, dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.camera.motion_blur import exposed, motion_while_open
from geogs_synth.clips.covering import bared, papered
from geogs_synth.clips.movers import BODIES, PARTS, people, traffic
from geogs_synth.clips.path_choice import too_near
from geogs_synth.clips.paths import Paths
from geogs_synth.clips.room_options import BARE, PAPERED, PEOPLE, STREET, RoomOptions
from geogs_synth.clips.shake import Shake, draw_shake
from geogs_synth.clips.street_clips import MIDDLE, SCALE, draw_street
from geogs_synth.draw import Draw
from geogs_synth.raycast.caster import RenderedRooms
from geogs_synth.scene.batch import chosen
from geogs_synth.scene.rooms import Rooms
from geogs_synth.scene.solids import NONE, SolidBatch, Solids


@dataclass(frozen=True)
class Dynamics:
    """What is unusual in each of b clips."""

    kind: Int[Tensor, "b"]
    """Kind of the scene, its number in :mod:`geogs_synth.clips.room_options`."""
    shake: Shake
    ways: Float[Tensor, "b n 3"]
    """Metres by which the solid of a place moves from view to view."""

    def ways_of(self, solid: Int[Tensor, "b *s"]) -> Float[Tensor, "b *s 3"]:
        """Those of the solids that pixels show; none of the room itself."""
        none = torch.zeros_like(self.ways[:, :1])
        ways = torch.cat([none, self.ways], 1)
        rows = torch.arange(len(ways), device=ways.device)
        return ways[rows.reshape(-1, *[1] * (solid.ndim - 1)), solid + 1]

    def out_of_the_way(self, solids: SolidBatch, views: CameraBatch) -> SolidBatch:
        """Without what comes too near to a camera on its way."""
        for step in range(1, views.T_cw.shape[1]):
            solids = solids.without(too_near(solids.moved_by(self.ways, step), views))
        return solids

    def blurred(self, rendering: RenderedRooms, views: CameraBatch) -> Float[Tensor, "b v 3 h w"]:
        """The light of views while their shutters are open."""
        shake = self.shake
        camera = shake.rate * shake.exposure[..., None]
        fraction = (shake.objects[:, None] * shake.exposure)[..., None, None, None]
        things = fraction * self.ways_of(rendering.solid)
        return exposed(rendering.colour, motion_while_open(views, rendering.depth, camera, things))


def draw_dynamics(
    draw: Draw, options: RoomOptions, rooms: Rooms, paths: Paths, materials: int
) -> tuple[Rooms, Paths, Dynamics]:
    """Makes of usual rooms, and paths in them, what the kinds of scenes are; on the host."""
    b, places = rooms.solids.kind.shape
    kind = draw.choose(astuple(options.scenes), b)
    surfaces = papered(draw, rooms.surfaces, kind == PAPERED)
    rooms = Rooms(rooms.size, rooms.solids, bared(draw, surfaces, kind == BARE), rooms.lights)
    street = kind == STREET
    bodies, steps = people(draw, rooms.size)
    if bool(street.any()):
        others, other_paths = draw_street(draw, options, b, places, materials)
        rooms, paths = chosen(street, others, rooms), chosen(street, other_paths, paths)
        cars, drives = traffic(draw, torch.tensor(MIDDLE), SCALE, b)
        bodies, steps = (
            chosen(street, cars, bodies),
            torch.where(street[:, None, None], drives, steps),
        )
    solids, ways = _with_bodies(rooms.solids, bodies, steps, (kind == PEOPLE) | street)
    rooms = Rooms(rooms.size, solids, rooms.surfaces, rooms.lights)
    return rooms, paths, Dynamics(kind, draw_shake(draw, kind, options.views), ways)


def _with_bodies(
    solids: SolidBatch, bodies: SolidBatch, steps: Float[Tensor, "b k 3"], which: Bool[Tensor, "b"]
) -> tuple[SolidBatch, Float[Tensor, "b n 3"]]:
    """Bodies in the last places of some scenes, and what all solids move by."""
    count = BODIES * PARTS
    rest = solids.at(torch.arange(solids.kind.shape[1] - count))
    found = chosen(which, Solids.join([rest, bodies]), solids)
    ways = torch.nn.functional.pad(steps, (0, 0, rest.kind.shape[1], 0))
    there = which[:, None] & (found.kind != NONE)
    return found, torch.where(there[..., None], ways, 0.0)
