"""Views of rooms and where their points are in other views: kernels on a GPU, PyTorch elsewhere."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs_train.rooms.raycast import Hit, closest_hit
from geogs_train.rooms.reference import (
    MARGIN,
    FlowTruth,
    Rendering,
    flow_by_torch,
    render_by_torch,
)
from geogs_train.rooms.scene import Rooms, Solids, packed_solids
from geogs_train.rooms.textures import TextureBank
from geogs_train.rooms.views import Views

SOURCE = Path(__file__).with_name("rooms.cu")
MOST_SOLIDS = 128
_BLOCK = (16, 8)


def render(rooms: Rooms, bank: TextureBank, views: Views) -> Rendering:
    """What every view sees."""
    if views.T_cw.device.type == "cuda":
        return render_by_kernel(rooms, bank, views)
    return render_by_torch(rooms, bank, views)


def flow(
    solids: Solids, views: Views, depth: Float[Tensor, "b v h w"], first: int, second: int
) -> FlowTruth:
    """Where the points that the view ``first`` sees at ``depth`` are in the view ``second``."""
    if views.T_cw.device.type == "cuda":
        return flow_by_kernel(solids, views, depth, first, second)
    return flow_by_torch(solids, views, depth, first, second)


def first_hit(
    size: Float[Tensor, "b 3"], solids: Solids, origin: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
) -> Hit:  # fmt: skip
    """The first thing that each ray from inside a room meets."""
    if origin.device.type == "cuda":
        return first_hit_by_kernel(size, solids, origin, direction)
    return closest_hit(size, solids, origin, direction)


def render_by_kernel(rooms: Rooms, bank: TextureBank, views: Views) -> Rendering:
    """:func:`render` by the CUDA kernel."""
    b, v = views.T_cw.shape[:2]
    shape, device = (b, v, views.height, views.width), views.T_cw.device
    depth = torch.empty(shape, device=device)
    colour, normal = (torch.empty(b, v, 3, *shape[2:], device=device) for _ in range(2))
    count, lights = _count(rooms.solids), rooms.lights.position.shape[2]
    kernels_for(SOURCE, device)["render_rooms"](
        _grid(views, b * v), _BLOCK, rooms.size.float().contiguous(), packed_solids(rooms.solids),
        rooms.surfaces.packed(), rooms.lights.packed(), views.packed(), bank.texels, colour, depth,
        normal, v, count, lights, bank.size, bank.levels, bank.texels.shape[1], views.width,
        views.height,
    )  # fmt: skip
    return Rendering(colour, depth, normal)


def flow_by_kernel(
    solids: Solids, views: Views, depth: Float[Tensor, "b v h w"], first: int, second: int
) -> FlowTruth:
    """:func:`flow` by the CUDA kernel."""
    b, device = len(depth), depth.device
    shape = (b, views.height, views.width)
    pixels = torch.empty(*shape, 2, device=device)
    visible, valid = (torch.empty(shape, dtype=torch.bool, device=device) for _ in range(2))
    cameras = views.packed()
    kernels_for(SOURCE, device)["flow_rooms"](
        _grid(views, b), _BLOCK, packed_solids(solids), cameras[:, first].contiguous(),
        cameras[:, second].contiguous(), depth[:, first].contiguous(), pixels, visible, valid,
        _count(solids), views.width, views.height, MARGIN,
    )  # fmt: skip
    return FlowTruth(pixels, visible, valid)


def first_hit_by_kernel(
    size: Float[Tensor, "b 3"], solids: Solids, origin: Float[Tensor, "b m 3"],
    direction: Float[Tensor, "b m 3"],
) -> Hit:  # fmt: skip
    """:func:`first_hit` by the CUDA kernel."""
    b, rays = origin.shape[:2]
    t = torch.empty(b, rays, device=origin.device)
    solid = torch.empty(b, rays, dtype=torch.int32, device=origin.device)
    kernels_for(SOURCE, origin.device)["first_hits"](
        (-(-rays // 128), b), 128, size.contiguous(), packed_solids(solids), origin.contiguous(),
        direction.contiguous(), t, solid, rays, _count(solids),
    )  # fmt: skip
    return Hit(t, solid.long())


def _count(solids: Solids) -> int:
    count = solids.kind.shape[1]
    if count > MOST_SOLIDS:
        raise ValueError(f"A room has {count} places for solids; the kernels take {MOST_SOLIDS}.")
    return count


def _grid(views: Views, count: int) -> tuple[int, int, int]:
    return -(-views.width // _BLOCK[0]), -(-views.height // _BLOCK[1]), count
