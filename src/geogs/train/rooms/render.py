"""Views of rooms and where their points are in other views: kernels on a GPU, PyTorch elsewhere."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.train.rooms.raycast import closest_hit, occluded, surface_point
from geogs.train.rooms.scene import Rooms, Solids, packed_solids
from geogs.train.rooms.shading import ambient_access, shade
from geogs.train.rooms.textures import TextureBank

SOURCE = Path(__file__).with_name("rooms.cu")
MOST_SOLIDS = 96
MARGIN = 1.5e-3
"""Metres before a point within which nothing hides it, since it lies on a solid itself."""
MIN_Z = 0.01
"""Metres before a camera from where on points have a place in its image."""
_BLOCK = (16, 8)
_CHUNK = 512


@dataclass(frozen=True)
class Views:
    """Cameras: v views in each of b rooms."""

    T_cw: Float[Tensor, "b v 4 4"]
    """World to camera, OpenCV axes."""
    intrinsics: Float[Tensor, "b 4"]
    """fx fy cx cy in pixels, pixel centres at integers."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    @property
    def R_wc(self) -> Float[Tensor, "b v 3 3"]:
        """Camera to world."""
        return self.T_cw[..., :3, :3].transpose(-1, -2)

    @property
    def centre(self) -> Float[Tensor, "b v 3"]:
        """Of the cameras, world, metres."""
        return -(self.R_wc @ self.T_cw[..., :3, 3:])[..., 0]

    def packed(self) -> Float[Tensor, "b v 16"]:
        """What the kernels read: camera to world by rows, then the intrinsics."""
        pose = torch.cat([self.R_wc, self.centre[..., None]], -1).flatten(-2)
        k = self.intrinsics[:, None].expand(-1, pose.shape[1], -1)
        return torch.cat([pose, k], -1).float().contiguous()


@dataclass(frozen=True)
class Rendering:
    """What views see."""

    colour: Float[Tensor, "b v 3 h w"]
    """Linear, the mean of four samples per pixel."""
    depth: Float[Tensor, "b v h w"]
    """z along the optical axis in metres, of the ray through the pixel's centre."""


@dataclass(frozen=True)
class FlowTruth:
    """Where the points that one view sees are in another."""

    pixels: Float[Tensor, "b h w 2"]
    """x, y in the second view."""
    visible: Bool[Tensor, "b h w"]
    """In the second image, and nothing hides it there."""
    valid: Bool[Tensor, "b h w"]
    """In front of the second camera; elsewhere the pixels mean nothing."""


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


def render_by_kernel(rooms: Rooms, bank: TextureBank, views: Views) -> Rendering:
    """:func:`render` by the CUDA kernel."""
    b, v = views.T_cw.shape[:2]
    shape, device = (b, v, views.height, views.width), views.T_cw.device
    depth = torch.empty(shape, device=device)
    colour = torch.empty(b, v, 3, views.height, views.width, device=device)
    count, lights = _count(rooms.solids), rooms.lights.position.shape[2]
    kernels_for(SOURCE, device)["render_rooms"](
        _grid(views, b * v), _BLOCK, rooms.size.float().contiguous(), packed_solids(rooms.solids),
        rooms.surfaces.packed(), rooms.lights.packed(), views.packed(), bank.texels, colour, depth,
        v, count, lights, bank.size, bank.levels, bank.texels.shape[1], views.width, views.height,
    )  # fmt: skip
    return Rendering(colour, depth)


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


def _count(solids: Solids) -> int:
    count = solids.kind.shape[1]
    if count > MOST_SOLIDS:
        raise ValueError(f"A room has {count} places for solids; the kernels take {MOST_SOLIDS}.")
    return count


def _grid(views: Views, count: int) -> tuple[int, int, int]:
    return -(-views.width // _BLOCK[0]), -(-views.height // _BLOCK[1]), count


def render_by_torch(rooms: Rooms, bank: TextureBank, views: Views) -> Rendering:
    """:func:`render` in PyTorch, in the precision of the rooms and views."""
    b, v = views.T_cw.shape[:2]
    x, y = _pixel_grid(views)
    colours, depths = [], []
    for view in range(v):
        for start in range(0, len(x), _CHUNK):
            part = slice(start, start + _CHUNK)
            colour, depth = _look(rooms, bank, views, view, x[part], y[part])
            colours.append(colour)
            depths.append(depth)
    shape = (b, v, views.height, views.width)
    colour = torch.cat(colours, 1).reshape(*shape, 3).movedim(-1, 2).contiguous()
    return Rendering(colour, torch.cat(depths, 1).reshape(shape))


def flow_by_torch(
    solids: Solids, views: Views, depth: Float[Tensor, "b v h w"], first: int, second: int
) -> FlowTruth:
    """:func:`flow` in PyTorch, in the precision of the depth."""
    shape = (len(depth), views.height, views.width)
    origin, direction = rays(views, first, *_pixel_grid(views))
    point = origin + depth[:, first].flatten(1)[..., None] * direction
    pixels, valid = project(views, second, point)
    limit = torch.tensor([views.width - 1, views.height - 1], device=pixels.device)
    inside = valid & ((pixels >= 0) & (pixels <= limit)).all(-1)
    centre = views.centre[:, second, None].expand_as(point)
    hidden = []
    for start in range(0, point.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        ray = point[:, part] - centre[:, part]
        hidden.append(occluded(solids, centre[:, part], ray, 1 - MARGIN / ray.norm(dim=-1)))
    visible = inside & ~torch.cat(hidden, 1)
    return FlowTruth(pixels.reshape(*shape, 2), visible.reshape(shape), valid.reshape(shape))


def rays(
    views: Views, view: int, x: Float[Tensor, "m"], y: Float[Tensor, "m"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 3"]]:
    """Origins and directions (of unit z) of the rays through pixels, world frame."""
    fx, fy, cx, cy = views.intrinsics[:, :, None].unbind(1)
    d = torch.stack(torch.broadcast_tensors((x - cx) / fx, (y - cy) / fy, torch.ones_like(fx)), -1)
    direction = torch.einsum("bij,bmj->bmi", views.R_wc[:, view], d)
    return views.centre[:, view, None].expand_as(direction), direction


def project(
    views: Views, view: int, point: Float[Tensor, "b m 3"]
) -> tuple[Float[Tensor, "b m 2"], Bool[Tensor, "b m"]]:
    """Pixels of world points in a view, and which lie before its camera."""
    ray = point - views.centre[:, view, None]
    x, y, z = torch.einsum("bij,bmj->bmi", views.T_cw[:, view, :3, :3], ray).unbind(-1)
    fx, fy, cx, cy = views.intrinsics[:, :, None].unbind(1)
    safe = z.clamp_min(MIN_Z)
    return torch.stack([fx * x / safe + cx, fy * y / safe + cy], -1), z > MIN_Z


def _pixel_grid(views: Views) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    k = views.intrinsics
    x, y = (torch.arange(n, dtype=k.dtype, device=k.device) for n in (views.width, views.height))
    return x.repeat(views.height), y.repeat_interleave(views.width)


def _look(
    rooms: Rooms, bank: TextureBank, views: Views, view: int,
    x: Float[Tensor, "m"], y: Float[Tensor, "m"],
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m"]]:  # fmt: skip
    """Colour and depth of some pixels of a view."""
    origin, direction = rays(views, view, x, y)
    hit = closest_hit(rooms, origin, direction)
    access = ambient_access(rooms, surface_point(rooms, hit, origin, direction))
    focal = (views.intrinsics[:, :1] * views.intrinsics[:, 1:2]).sqrt()
    total = torch.zeros_like(direction)
    for k in range(4):
        origin, ray = rays(views, view, x + (k % 2 - 0.5) / 2, y + (k // 2 - 0.5) / 2)
        seen = closest_hit(rooms, origin, ray)
        point = surface_point(rooms, seen, origin, ray)
        footprint = 0.5 * seen.t * ray.norm(dim=-1) / focal
        total = total + shade(rooms, bank, point, view, k, ray, footprint, access)
    return total / 4, hit.t
