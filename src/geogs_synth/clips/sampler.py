"""Clips of random rooms: a room, its light, a camera path, pictures of an imperfect camera."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.camera.clip_camera import RandomFlaws, develop, draw_flaws
from geogs_synth.clips.clip_batch import ClipBatch
from geogs_synth.clips.dynamics import Dynamics, draw_dynamics
from geogs_synth.clips.furnishing import draw_furnishing
from geogs_synth.clips.lights import draw_lights
from geogs_synth.clips.materials import draw_surfaces
from geogs_synth.clips.path_choice import choose_cameras, too_near
from geogs_synth.clips.paths import Paths, draw_paths
from geogs_synth.clips.room_options import RoomOptions, only_scene
from geogs_synth.draw import Draw
from geogs_synth.raycast.caster_choice import caster_for
from geogs_synth.raycast.rendered_rooms import RenderedRooms
from geogs_synth.scene.batch import on_device
from geogs_synth.scene.rooms import MOST_SOLIDS, Rooms, room_per_view
from geogs_synth.textures.bank import make_bank
from geogs_synth.textures.pyramids import TextureBank


@dataclass(frozen=True)
class Plan:
    """All random parts of a batch except the noise of its pixels; on the host."""

    key: tuple[int, ...]
    """Key of the random numbers."""
    rooms: Rooms
    paths: Paths
    flaws: RandomFlaws
    dynamics: Dynamics | None = None
    """Motion and kinds of the scenes; None where all are usual."""


class RoomSampler:
    """An endless supply of clips; each batch depends only on the seed, the step and the rank."""

    def __init__(
        self,
        options: RoomOptions,
        device: torch.device | str,
        seed: int = 0,
        bank: TextureBank | None = None,
    ) -> None:
        """``bank`` may be that of a sampler with the same textures."""
        self.options = options
        self.device = torch.device(device)
        self.seed = seed
        self.bank = bank or make_bank(
            options.textures, options.texture_size, seed, self.device, options.validation
        )

    def sample(self, step: int, batch: int, rank: int = 0) -> ClipBatch:
        """``batch`` clips for a training step of a process; the same at every call.

        The rooms are the same on every device, only the noise differs. The host does not wait for
        the device.
        """
        return self.film(self.plan(step, batch, rank))

    def plan(self, step: int, batch: int, rank: int = 0) -> Plan:
        """The part of :meth:`sample` that is drawn on the host."""
        return draw_plan(self.options, self.bank.materials, self.seed, step, batch, rank)

    @torch.no_grad()
    def film(self, plan: Plan) -> ClipBatch:
        """Render the clips of a plan."""
        options = self.options
        key = plan.key
        plan = on_device(plan, self.device)
        size = plan.rooms.size
        solids = plan.rooms.solids
        views = choose_cameras(plan.paths, size, solids, options.width, options.height)
        solids = solids.without(too_near(solids, views))
        dynamics = plan.dynamics
        if dynamics is not None:
            solids = dynamics.out_of_the_way(solids, views)
            views = replace(views, sweep=dynamics.shake.sweep)
        rooms = replace(plan.rooms, solids=solids)
        if dynamics is None:
            seen = caster_for(self.device).render(rooms, self.bank, views)
            light = seen.colour
        else:
            seen = self._render_moving(rooms, views, dynamics.velocity)
            light = dynamics.blurred(seen, views)
        images = develop(Draw.keyed(self.device, *key), plan.flaws, light)
        return ClipBatch(
            images, light, seen.depth, seen.normal, seen.solid, views, solids, dynamics
        )

    def _render_moving(
        self, rooms: Rooms, views: CameraBatch, velocity: Float[Tensor, "b n 3"]
    ) -> RenderedRooms:
        """Render every view of rooms whose solids move by ``velocity`` (metres per view)."""
        b, v = views.T_cw.shape[:2]
        rooms = room_per_view(rooms, v, velocity)
        seen = caster_for(self.device).render(rooms, self.bank, views.as_rooms())
        return RenderedRooms(*(x.flatten(0, 1).unflatten(0, (b, v)) for x in vars(seen).values()))


@torch.no_grad()
def draw_plan(
    options: RoomOptions, materials: int, seed: int, step: int, batch: int, rank: int
) -> Plan:
    """A batch of rooms, lights, paths and flaws, given how many materials the bank has.

    Drawn on the host: thousands of tiny steps, which a GPU would not do faster.
    """
    key = (seed, int(options.validation), step, rank)
    draw = Draw.keyed(torch.device("cpu"), *key)
    least = torch.tensor([2.5, 2.5, 2.2])  # metres
    most = torch.tensor([8.0, 8.0, 3.5])
    size = least + (most - least) * draw.uniform(0, 1, batch, 3)
    layout = draw_furnishing(draw, size, options.least_density, options.most_density, options.thin)
    surfaces = draw_surfaces(draw, layout, options.textures, materials)
    lights = draw_lights(draw, size, options.views, options.light_change)
    paths = draw_paths(draw, options, size)
    flaws = draw_flaws(draw, batch, options.views, options.clean, options.disturbance)
    rooms = Rooms(size, layout.solids, surfaces, lights).with_places(MOST_SOLIDS)
    if options.scenes == only_scene("usual"):
        return Plan(key, rooms, paths, flaws)
    rooms, paths, dynamics = draw_dynamics(draw, options, rooms, paths, materials)
    return Plan(key, rooms, paths, flaws, dynamics)
