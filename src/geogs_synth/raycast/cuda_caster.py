"""The caster for CUDA."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.raycast.cpu_caster import CpuCaster
from geogs_synth.raycast.rays import Hit
from geogs_synth.raycast.rendered_rooms import MARGIN, FlowTruth, RenderedRooms
from geogs_synth.scene.rooms import MOST_SOLIDS, Rooms, packed_solids
from geogs_synth.scene.solids import SolidBatch
from geogs_synth.textures.pyramids import TextureBank

SOURCE = Path(__file__).with_name("rooms.cu")
_BLOCK = (16, 8)


class CudaCaster(CpuCaster):
    """Renders by the kernels of ``rooms.cu``."""

    def render(self, rooms: Rooms, bank: TextureBank, views: CameraBatch) -> RenderedRooms:
        """Render every view."""
        b, v = views.T_cw.shape[:2]
        shape = (b, v, views.height, views.width)
        device = views.T_cw.device
        depth = torch.empty(shape, device=device)
        colour, normal = (torch.empty(b, v, 3, *shape[2:], device=device) for _ in range(2))
        solid = torch.empty(shape, dtype=torch.int32, device=device)
        count = _count(rooms.solids)
        lights = rooms.lights.position.shape[2]
        kernels_for(SOURCE, device)["render_rooms"](
            _grid(views, b * v), _BLOCK, rooms.size.float().contiguous(),
            packed_solids(rooms.solids), rooms.surfaces.packed(), rooms.lights.packed(),
            views.packed(), bank.texels, colour, depth, normal, solid, v, count, lights, bank.size,
            bank.levels, bank.texels.shape[1], views.width, views.height,
        )  # fmt: skip
        return RenderedRooms(colour, depth, normal, solid.long())

    def flow(
        self, solids: SolidBatch, views: CameraBatch, points: Float[Tensor, "b h w 3"], view: int
    ) -> FlowTruth:
        """Pixels and visibility of world points in a view."""
        b, height, width = points.shape[:3]
        pixels = torch.empty(b, height, width, 2, device=points.device)
        visible, valid = (torch.empty_like(pixels[..., 0], dtype=torch.bool) for _ in range(2))
        kernels_for(SOURCE, points.device)["flow_rooms"](
            _grid(views, b), _BLOCK, packed_solids(solids), views.packed()[:, view].contiguous(),
            points.float().contiguous(), pixels, visible, valid, _count(solids), width, height,
            MARGIN,
        )  # fmt: skip
        return FlowTruth(pixels, visible, valid)

    def first_hit(
        self,
        size: Float[Tensor, "b 3"],
        solids: SolidBatch,
        origin: Float[Tensor, "b m 3"],
        direction: Float[Tensor, "b m 3"],
    ) -> Hit:
        """First hit of each ray from inside a room."""
        b, rays = origin.shape[:2]
        t = torch.empty(b, rays, device=origin.device)
        solid = torch.empty(b, rays, dtype=torch.int32, device=origin.device)
        kernels_for(SOURCE, origin.device)["first_hits"](
            (-(-rays // 128), b), 128, size.contiguous(), packed_solids(solids),
            origin.contiguous(), direction.contiguous(), t, solid, rays, _count(solids),
        )  # fmt: skip
        return Hit(t, solid.long())


def _count(solids: SolidBatch) -> int:
    count = solids.kind.shape[1]
    if count > MOST_SOLIDS:
        raise ValueError(f"A room has {count} places for solids; the kernels take {MOST_SOLIDS}.")
    return count


def _grid(views: CameraBatch, count: int) -> tuple[int, int, int]:
    return -(-views.width // _BLOCK[0]), -(-views.height // _BLOCK[1]), count
