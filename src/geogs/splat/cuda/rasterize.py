"""The passes of the renderer on a GPU."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.splat.map import DiskParameters

SOURCE = Path(__file__).with_name("renderer.cu")
TILE = 16
THREADS = 256
RECORD, OUTLINE, SUMS, POSE_COPIES = 16, 8, 16, 32
"""Floats per disk of the record, of the outline and of the pixels' sums; see the sources."""


@dataclass(slots=True)
class Maps:
    """What :class:`geogs.splat.render.RenderOutput` holds, for several views."""

    depth: Float[Tensor, "b h w"]
    normal: Float[Tensor, "b 3 h w"]
    alpha: Float[Tensor, "b h w"]
    distortion: Float[Tensor, "b h w"]
    median_depth: Float[Tensor, "b h w"]
    visible: Bool[Tensor, "n"]
    """Of any view."""


@dataclass(slots=True)
class Lists:
    """The disks of every tile of every view, nearest first."""

    offsets: Tensor
    """(b tiles + 1,) int32, where each tile's entries start."""
    disks: Tensor
    """(room,) int32."""
    room: int


@dataclass(slots=True)
class Trace:
    """What a forward pass leaves for its backward pass."""

    parameters: DiskParameters
    poses: Float[Tensor, "b 3 4"]
    camera: Camera
    near: float
    records: Tensor
    outlines: Tensor
    lists: Lists
    saved: Float[Tensor, "b 2 h w"]
    ranks: Tensor


def blocks(count: int) -> int:
    """Blocks of THREADS threads for so many elements."""
    return -(-count // THREADS)


def tile_grid(camera: Camera) -> int:
    """Tiles of an image."""
    return -(-camera.width // TILE) * -(-camera.height // TILE)


def rasterize_forward(
    parameters: DiskParameters,
    camera: Camera,
    poses: Float[Tensor, "b 3 4"],
    near: float,
    with_trace: bool = True,
) -> tuple[Maps, Trace | None]:
    """Render the disks from all poses (float64, world to camera) in one launch of each kernel.

    All tensors lie on one GPU; the parameters are contiguous float32. The number of list entries is
    read back once, which waits for the projection but not for the compositing.
    """
    device, n, b = parameters.position.device, len(parameters.position), len(poses)
    width, height, tiles = camera.width, camera.height, b * tile_grid(camera)
    kernels = kernels_for(SOURCE, device)
    # Cleared together: status, tile counts, visible.
    cleared = torch.zeros(2 + tiles + -(-n // 4), dtype=torch.int32, device=device)
    status, counts = cleared[:2], cleared[2 : 2 + tiles]
    visible = cleared[2 + tiles :].view(torch.bool)[:n]
    places = torch.empty(2 * tiles + 1, dtype=torch.int32, device=device)
    offsets, cursor = places[: tiles + 1], places[tiles + 1 :]
    records = torch.empty(b, n, RECORD, device=device)
    outlines = torch.empty(b, n, OUTLINE, device=device)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    grid = (blocks(n), b)
    kernels["project_disks"](
        grid, THREADS, n, None, *parameters, poses, None, *lens, near, width, height,
        records, outlines, counts,
    )  # fmt: skip
    kernels["scan_tiles"](1, 1024, tiles, 2**31 - 1, counts, offsets, cursor, status)
    room = int(status[0])
    keys = torch.empty(room, dtype=torch.int64, device=device)
    disks = torch.empty(room, dtype=torch.int32, device=device)
    kernels["list_disks"](
        grid, THREADS, n, None, records, outlines, width, height, room, cursor, keys
    )
    kernels["sort_tiles"](tiles, THREADS, room, offsets, keys, disks)
    lists = Lists(offsets, disks, room)
    planes = torch.empty(10 if with_trace else 7, b * height * width, device=device)
    shape = (b, height, width)
    depth, alpha, distortion, median_depth = (planes[k].view(shape) for k in range(4))
    normal = planes[4:7].view(b, 3, height, width)
    saved = planes[7:9].view(b, 2, height, width) if with_trace else None
    ranks = planes[9].view(torch.int32).view(shape) if with_trace else None
    kernels["blend_tiles"](
        (tiles // b, b), THREADS, n, records, outlines, offsets, disks, room, 1 / near, width,
        height, depth, normal, alpha, distortion, median_depth, saved, ranks, visible,
    )  # fmt: skip
    maps = Maps(depth, normal, alpha, distortion, median_depth, visible)
    if saved is None or ranks is None:
        return maps, None
    return maps, Trace(parameters, poses, camera, near, records, outlines, lists, saved, ranks)


@dataclass(slots=True)
class Gradients:
    """Of the disks' parameters, and of the upper three rows of every pose (float64)."""

    parameters: DiskParameters
    poses: Float[Tensor, "b 3 4"] | None


def rasterize_backward(
    trace: Trace,
    d_depth: Float[Tensor, "b h w"],
    d_normal: Float[Tensor, "b h w 3"],
    d_alpha: Float[Tensor, "b h w"],
    d_distortion: Float[Tensor, "b h w"],
    with_poses: bool = True,
) -> Gradients:
    """Gradients of a loss, summed over the views, given its float32 map gradients.

    They are contiguous; the normal's may instead be contiguous with the components in front.
    """
    n, b = trace.records.shape[1], trace.records.shape[0]
    camera, device, lists = trace.camera, trace.records.device, trace.lists
    kernels = kernels_for(SOURCE, device)
    width, height = camera.width, camera.height
    strides = (3, 1)
    if not d_normal.is_contiguous():
        d_normal, strides = d_normal.permute(0, 3, 1, 2), (1, width * height)
    sums = torch.zeros(b, n, SUMS, device=device)
    kernels["unblend_tiles"](
        (tile_grid(camera), b), THREADS, n, trace.records, trace.outlines, lists.offsets,
        lists.disks, lists.room, 1 / trace.near, width, height, trace.saved, trace.ranks, d_depth,
        d_normal, *strides, d_alpha, d_distortion, sums,
    )  # fmt: skip
    flat = torch.empty(10 * n, device=device)
    parameters = DiskParameters(
        flat[: 3 * n].view(n, 3),
        flat[3 * n : 7 * n].view(n, 4),
        flat[7 * n : 9 * n].view(n, 2),
        flat[9 * n :],
    )
    copies = None
    if with_poses:
        copies = torch.zeros(POSE_COPIES, b, 16, dtype=torch.float64, device=device)
    kernels["project_backward"](
        blocks(n), THREADS, n, None, b, *trace.parameters, trace.poses, None, camera.fx, camera.fy,
        trace.outlines, sums, *parameters, copies,
    )  # fmt: skip
    poses = None if copies is None else copies.sum(0)[:, :12].unflatten(1, (3, 4))
    return Gradients(parameters, poses)
