"""Clips of random rooms: a room, its light, a camera path, pictures of an imperfect camera."""

import torch

from geogs.train.rooms.bank import make_bank
from geogs.train.rooms.cameras import draw_cameras, too_near
from geogs.train.rooms.clips import ClipBatch
from geogs.train.rooms.disturb import develop
from geogs.train.rooms.draw import Draw
from geogs.train.rooms.layout import draw_layout
from geogs.train.rooms.materials import draw_lights, draw_surfaces
from geogs.train.rooms.options import RoomOptions
from geogs.train.rooms.render import render
from geogs.train.rooms.scene import Rooms


class RoomSampler:
    """An endless supply of clips; each batch depends only on the seed, the step and the rank."""

    def __init__(self, options: RoomOptions, device: torch.device | str, seed: int = 0) -> None:
        self.options = options
        self.device = torch.device(device)
        self._seed = seed
        self.bank = make_bank(
            options.textures, options.texture_size, seed, self.device, options.validation
        )

    @torch.no_grad()
    def sample(self, step: int, batch: int, rank: int = 0) -> ClipBatch:
        """``batch`` clips for a training step of a process; the same whenever it is asked for.

        Nothing waits for the device.
        """
        options = self.options
        draw = Draw(self.device, self._seed, int(options.validation), step, rank)
        size = draw.uniform(0, 1, batch, 3) * torch.tensor([5.5, 5.5, 1.3], device=self.device)
        size = size + torch.tensor([2.5, 2.5, 2.2], device=self.device)
        layout = draw_layout(draw, size, options.density)
        surfaces = draw_surfaces(draw, layout, options.textures)
        lights = draw_lights(draw, size, options.views, options.light_change)
        views = draw_cameras(draw, options, size, layout.solids)
        solids = layout.solids.without(too_near(layout.solids, views))
        rendering = render(Rooms(size, solids, surfaces, lights), self.bank, views)
        images = develop(draw, options, rendering.colour)
        return ClipBatch(images, rendering.depth, views.T_cw, views.intrinsics, solids)
