"""The caster for the CPU: compiled rays, shading in PyTorch. The CUDA kernels do the same."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch, pixel_grid, project, rays, row_centre
from geogs_synth.raycast.rays import Hit, closest_hit, occluded
from geogs_synth.raycast.rendered_rooms import MARGIN, FlowTruth, RenderedRooms
from geogs_synth.raycast.room_shading import ambient_access, shade
from geogs_synth.raycast.room_surface import surface_point
from geogs_synth.scene.batch import one_scene
from geogs_synth.scene.rooms import Rooms
from geogs_synth.scene.solids import SolidBatch
from geogs_synth.textures.pyramids import TextureBank

SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
"""Positions of a pixel's four samples in it: no two in a row or column."""
_CHUNK = 2048
"""Pixels at a time; the data of the rays then stays in the processor's cache."""


class CpuCaster:
    """Casts rays at batches of rooms, in the precision of the rooms and views."""

    def render(self, rooms: Rooms, bank: TextureBank, views: CameraBatch) -> RenderedRooms:
        """Render every view."""
        b, v = views.T_cw.shape[:2]
        x, y = pixel_grid(views)
        seen = [
            _look(one_scene(rooms, room), bank, one_scene(views, room), view, x[part], y[part])
            for room in range(b)
            for view in range(v)
            for part in _chunks(len(x))
        ]
        shape = (b, v, views.height, views.width)
        colour, depth, normal, solid = (torch.cat([s[k] for s in seen], 1) for k in range(4))
        colour, normal = (x.reshape(*shape, 3) for x in (colour, normal))
        normal = torch.einsum("bvij,bvhwj->bvhwi", views.T_cw[..., :3, :3], normal)
        colour, normal = (x.movedim(-1, 2).contiguous() for x in (colour, normal))
        return RenderedRooms(colour, depth.reshape(shape), normal, solid.reshape(shape))

    def flow(
        self, solids: SolidBatch, views: CameraBatch, points: Float[Tensor, "b h w 3"], view: int
    ) -> FlowTruth:
        """Pixels and visibility of world points in a view."""
        shape = points.shape[:3]
        point = points.flatten(1, 2)
        pixels, valid = project(views, view, point)
        limit = torch.tensor([views.width - 1, views.height - 1], device=pixels.device)
        inside = valid & ((pixels >= 0) & (pixels <= limit)).all(-1)
        centre = row_centre(views, view, pixels)
        ray = point - centre
        hidden = occluded(solids, centre, ray, 1 - MARGIN / ray.norm(dim=-1))
        visible = inside & ~hidden
        return FlowTruth(pixels.reshape(*shape, 2), visible.reshape(shape), valid.reshape(shape))

    def first_hit(
        self, size: Float[Tensor, "b 3"], solids: SolidBatch, origin: Float[Tensor, "b m 3"],
        direction: Float[Tensor, "b m 3"],
    ) -> Hit:  # fmt: skip
        """First hit of each ray from inside a room."""
        return closest_hit(size, solids, origin, direction)


def _chunks(pixels: int) -> list[slice]:
    return [slice(start, start + _CHUNK) for start in range(0, pixels, _CHUNK)]


def _look(
    rooms: Rooms, bank: TextureBank, views: CameraBatch, view: int,
    x: Float[Tensor, "m"], y: Float[Tensor, "m"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Colour, depth, normal (world frame) and solid of some pixels of a view."""
    origin, direction = rays(views, view, x, y)
    hit = closest_hit(rooms.size, rooms.solids, origin, direction)
    middle = surface_point(rooms, hit, origin, direction)
    access = ambient_access(rooms, middle)
    focal = (views.intrinsics[:, :1] * views.intrinsics[:, 1:2]).sqrt()
    total = torch.zeros_like(direction)
    for k in range(4):
        origin, ray = rays(views, view, x + SAMPLES[k][0], y + SAMPLES[k][1])
        seen = closest_hit(rooms.size, rooms.solids, origin, ray)
        point = surface_point(rooms, seen, origin, ray)
        footprint = 0.5 * seen.t * ray.norm(dim=-1) / focal
        total = total + shade(rooms, bank, point, view, k, ray, footprint, access)
    return total / 4, hit.t, middle.normal, hit.solid
